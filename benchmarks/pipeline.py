"""The whole pipeline in memory, from times to a robust fit, beside its bare stages, and with everything it says."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.fit import telemetry as with_base_field
from benchmarks.measure import Figure, interleaved_s
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.field.igrf import Igrf
from magcal_core.observations import Observations
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.reference.columns import with_reference
from magcal_core.reference.field_along_orbit import field_along
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel

Floats = NDArray[np.float64]

ROOM = "pipeline"
TLES = Path(__file__).resolve().parent.parent / "tests" / "data" / "dekart.tle.txt"
SENSOR = SensorModel(
    np.array([2928.125, -1191.25, -1875.625]),
    np.array([1.032695, 1.006685, 1.032875]),
    np.array([-4.53, -1.067, 7.915]),
)
AIMS_S = {700: 0.005, 100_000: 0.1, 1_000_000: 1.5}
OVER_STAGES = 2.0
OVER_BARE = 4.0
_ROUNDS = {700: 15, 100_000: 5, 1_000_000: 3}
_NOISE_NT = 60.0
_STRUCK = 0.02


def orbit() -> Sgp4Orbit:
    """Return the orbit that the samples are on."""
    return Sgp4Orbit(parse_tles(TLES.read_text())[0])


def telemetry(n: int, step_s: float) -> Samples:
    """Return ``n`` readings of a tumbling sensor on the orbit, with noise and spikes; no reference, no attitude."""
    path, field, random = orbit(), Igrf(), np.random.default_rng(n)
    t_utc = path.epoch_utc + np.round(np.arange(n) * step_s * 1e9).astype("timedelta64[ns]")
    h_nt = np.empty((n, 3))
    for start in range(0, n, 500_000):
        rows = slice(start, start + 500_000)
        b_nt = field.field_itrf_nt(t_utc[rows], path.position_itrf_km(t_utc[rows]))
        turn = np.deg2rad(0.76) * step_s * np.arange(n)[rows]
        slow = 0.41 * turn
        along = np.c_[np.cos(turn) * np.cos(slow), np.sin(turn) * np.cos(slow), np.sin(slow)]
        size = np.sqrt(np.einsum("ij,ij->i", b_nt, b_nt))
        h_nt[rows] = SENSOR.apply(along * size[:, None]) + _NOISE_NT * random.normal(size=b_nt.shape)
    struck = random.random(n) < _STRUCK
    h_nt[struck, 0] += random.uniform(3000.0, 25000.0, np.count_nonzero(struck))
    return Samples(t_utc, h_nt)


@dataclass(frozen=True, slots=True, eq=False)
class Stages:
    """One session, as a whole and stage by stage; every stage has what the one before gives."""

    samples: Samples
    path: Sgp4Orbit
    field: Igrf
    places_km: Floats
    observations: Observations

    @classmethod
    def of(cls, samples: Samples) -> Stages:
        """Return the stages of ``samples``."""
        path, field = orbit(), Igrf()
        referenced, _ = with_reference(samples, [path], field)
        places_km = path.position_itrf_km(samples.t_utc)
        return cls(samples, path, field, places_km, Observations.of(referenced))

    def bare(self) -> object:
        """Times to robust fit, and nothing else."""
        referenced, _ = with_reference(self.samples, [self.path], self.field)
        return ESTIMATORS["scalar"].fit(Observations.of(referenced), FitSettings("soft_l1"))

    def field_nt(self) -> Floats:
        """Return the field, shape (n, 3), ITRF, nT: along the orbit where that pays, else at the positions."""
        along = field_along(self.path, self.field, self.samples.t_utc, is_gcrf=False, r_itrf_km=self.places_km)
        if along is not None:
            return along.at(self.samples.t_utc)
        return self.field.field_itrf_nt(self.samples.t_utc, self.places_km)

    def candidates(self) -> Mapping[str, Callable[[], object]]:
        """Return what takes turns."""
        fit = ESTIMATORS["scalar"].fit
        full = partial(calibrate, self.samples, [self.path], robust="soft_l1")
        return {
            "position": partial(self.path.position_itrf_km, self.samples.t_utc),
            "field": self.field_nt,
            "fit": partial(fit, self.observations, FitSettings("soft_l1")),
            "bare": self.bare,
            "full": partial(full, time_offset="none"),
            "full, clock": partial(full, time_offset="estimate"),
        }


def measured(n: int, rounds: int) -> Iterator[Figure]:
    """Yield the figures of a session of ``n`` samples."""
    # 10 s as the paper samples, 1 s where that would be years.
    stages = Stages.of(telemetry(n, 10.0 if n < 10_000 else 1.0))
    times = interleaved_s(stages.candidates(), rounds)
    bare, aim = times["bare"], AIMS_S[n]
    parts = times["position"] + times["field"] + times["fit"]
    note = ", ".join(f"{name} {1e3 * times[name]:.3g} ms" for name in ("position", "field", "fit"))
    what = f"{n:.0e} samples" if n >= 10_000 else f"{n} samples"
    yield Figure(ROOM, f"times to robust fit, {what}", bare, "s", f"<= {aim:g}", bare <= aim, note)
    ratio = bare / parts
    yield Figure(ROOM, f"the same / its bare stages, {what}", ratio, "x", f"<= {OVER_STAGES:g}", ratio <= OVER_STAGES)
    full = times["full, clock"]
    yield Figure(
        ROOM, f"errors, observability, verdict, clock, {what}", full, "s", f"<= {OVER_BARE * aim:g}",
        full <= OVER_BARE * aim, f"without the clock {times['full']:.3g} s",
    )  # fmt: skip
    ratio = full / bare
    yield Figure(ROOM, f"all of it / times to robust fit, {what}", ratio, "x", f"<= {OVER_BARE:g}", ratio <= OVER_BARE)


def vector_figures(n: int, aim_s: float) -> Iterator[Figure]:
    """Yield the durations of calibrations by component, where the field in the base frame came with the telemetry."""
    known = with_base_field(n)
    runs = {loss: partial(calibrate, known, method="vector", robust=loss) for loss in ("none", "huber")}
    for loss, duration in interleaved_s(runs, 3).items():
        what = f"vector, loss {loss}, all of it, {n} samples"
        yield Figure(ROOM, what, duration, "s", f"<= {aim_s:g}", duration <= aim_s)


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    for n, rounds in _ROUNDS.items():
        yield from measured(n, rounds)
    for n in (700, 100_000):
        yield from vector_figures(n, OVER_BARE * AIMS_S[n])

"""What each field source leaves of the magnetosphere of CHAOS-7: of the field itself, and of a session's scale factors.

``MAGCAL_CHAOS`` is the path of ``CHAOS-7.mat`` as DTU Space publishes it; chaosmagpy has its magnetosphere (sources
in SM and GSM axes with what they induce in the Earth). ``MAGCAL_MAGNETOSPHERE`` is the number of sessions, 480 unless
told; two for each fifteen more are drawn in storms.

A session has 480 samples in 3.2 h on a circular orbit 300 to 1500 km high, at an instant from 2015 to the end of RC
as chaosmagpy brings it along. Each sample has an attitude of its own, all of them as likely, and no noise, so that what
the calibration, the plain fit of |B|, misses is the field's fault.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.external import INCLINATIONS, rc_index
from benchmarks.measure import Figure
from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import rotate, unit
from magcal_core.field.igrf import Igrf
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.models import field_model
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.simulation.external_missions import SAMPLES, STEP_S, circular_orbit_km, drawn_sensor

IS_STUDY = True
ROOM: Final = "magnetosphere"
SESSIONS: Final = 480
STORM_NT: Final = -100.0
"""RC below which a session counts as one in a storm, nT."""
FIELDS: Final = ("igrf-14", "igrf-14+mean", "igrf-14+rc, RC alone", "igrf-14+rc")
ALL: Final = "all"
STORMS: Final = "storms"
_FIRST_NS: Final = int(np.datetime64("2015-01-01", "ns").astype(np.int64))
_MEMORY_NS: Final = 5000 * HOUR_NS
_STORM_SEEDS: Final = 1_000_000


class Magnetosphere(Protocol):
    """What is asked of CHAOS-7."""

    def synth_values_sm(self, time: Floats, radius: Floats, theta: Floats, phi: Floats) -> tuple[Floats, ...]:
        """Return the field of the near magnetosphere, (r, theta, phi), nT."""

    def synth_values_gsm(self, time: Floats, radius: Floats, theta: Floats, phi: Floats) -> tuple[Floats, ...]:
        """Return the field of the remote magnetosphere, (r, theta, phi), nT."""


@dataclass(frozen=True, slots=True)
class Spread:
    """What a field source leaves, rms: of the size and of a component, nT, and of the common scale factor, ppm."""

    size_nt: float
    component_nt: float
    scale_ppm: float


def chaos() -> Magnetosphere:
    """Return CHAOS-7.

    Raises
    ------
    RuntimeError
        ``MAGCAL_CHAOS`` does not name its file.
    """
    path = os.environ.get("MAGCAL_CHAOS", "")
    if not path:
        raise RuntimeError("MAGCAL_CHAOS must be the path of CHAOS-7.mat, which DTU Space publishes")
    found: Magnetosphere = importlib.import_module("chaosmagpy").load_CHAOS_matfile(path)
    return found


def magnetosphere_nt(model: Magnetosphere, t_utc: Times, r_itrf_km: Floats) -> Floats:
    """Return the field of the magnetosphere at ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT."""
    days = (t_utc - np.datetime64("2000-01-01")) / np.timedelta64(1, "D")
    radius = np.linalg.norm(r_itrf_km, axis=1)
    theta, phi = np.arccos(r_itrf_km[:, 2] / radius), np.arctan2(r_itrf_km[:, 1], r_itrf_km[:, 0])
    place = (days, radius, np.rad2deg(theta), np.rad2deg(phi))
    parts = np.sum([model.synth_values_sm(*place), model.synth_values_gsm(*place)], axis=0)
    sin, cos, zero = np.sin(theta), np.cos(theta), np.zeros_like(phi)
    axes = (
        (sin * np.cos(phi), sin * np.sin(phi), cos),
        (cos * np.cos(phi), cos * np.sin(phi), -sin),
        (-np.sin(phi), np.cos(phi), zero),
    )
    return np.asarray(sum(part[:, None] * np.stack(axis, axis=1) for part, axis in zip(parts, axes, strict=True)))


def left_over(model: Magnetosphere, inclination_deg: float, seed: int, *, is_storm: bool) -> NDArray[np.float64]:
    """Return what each of `FIELDS` leaves in one session, mean squares of size, component, scale: (4, 3)."""
    random = np.random.default_rng(seed)
    rc = rc_index()
    begin_ns = _drawn_ns(random, rc, is_storm=is_storm)
    t_s = STEP_S * np.arange(SAMPLES, dtype=np.float64)
    t_utc = np.datetime64(begin_ns, "ns") + (t_s * 1e9).astype("timedelta64[ns]")
    r_km = circular_orbit_km(random, inclination_deg, t_s)
    true_nt = Igrf().field_itrf_nt(t_utc, r_km) + magnetosphere_nt(model, t_utc, r_km)
    sensor = drawn_sensor(random)
    h_nt = sensor.apply(rotate(unit(random.normal(size=(SAMPLES, 4))), true_nt))
    samples = Samples(t_utc, h_nt, r_itrf_km=r_km)
    parts = rc.between(begin_ns - _MEMORY_NS, begin_ns + 5 * HOUR_NS)
    none = np.full(parts.rows, np.nan)
    indices = {"igrf-14+rc": parts, "igrf-14+rc, RC alone": replace(parts, external_nt=none, induced_nt=none)}
    found = []
    for name in FIELDS:
        field, index = name.partition(",")[0], indices.get(name)
        used_nt = field_model(field, index=index).field_itrf_nt(t_utc, r_km)
        away_nt = np.linalg.norm(used_nt, axis=1) - np.linalg.norm(true_nt, axis=1)
        scale = _plain_scale(samples, field, index) / sensor.scale - 1.0
        found.append((np.mean(away_nt**2), np.mean((used_nt - true_nt) ** 2), (1e6 * scale.mean()) ** 2))
    return np.array(found)


def spreads(sessions: int = SESSIONS) -> dict[str, dict[str, Spread]]:
    """Return field source -> `ALL`, `STORMS` or an inclination, "10 deg" -> what is left."""
    model, squares = chaos(), {}
    for place, inclination in enumerate(INCLINATIONS):
        seeds = range(place, sessions, len(INCLINATIONS))
        squares[f"{inclination:g} deg"] = [left_over(model, inclination, seed, is_storm=False) for seed in seeds]
    squares[ALL] = [one for some in list(squares.values()) for one in some]
    squares[STORMS] = [
        left_over(model, INCLINATIONS[seed % len(INCLINATIONS)], _STORM_SEEDS + seed, is_storm=True)
        for seed in range(2 * sessions // 15)
    ]
    roots = {group: np.sqrt(np.mean(some, axis=0)) for group, some in squares.items()}
    return {
        name: {group: Spread(*map(float, root[row])) for group, root in roots.items()}
        for row, name in enumerate(FIELDS)
    }


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    sessions = int(os.environ.get("MAGCAL_MAGNETOSPHERE", SESSIONS))
    for field, groups in spreads(sessions).items():
        for group, left in groups.items():
            note = f"{sessions} sessions, seeds from 0; component {left.component_nt:.1f} nT"
            yield Figure(ROOM, f"{field}, {group}: |B| that is left, rms", left.size_nt, "nT", note=note)
            yield Figure(ROOM, f"{field}, {group}: common scale error, rms", left.scale_ppm, "ppm", note=note)


def _drawn_ns(random: np.random.Generator, rc: Index, *, is_storm: bool) -> int:
    """Return a session's begin; of one in a storm the middle is in an hour with RC below `STORM_NT`."""
    half_ns = int(0.5e9 * STEP_S * SAMPLES)
    last = int(rc.start_ns[-1]) - 4 * HOUR_NS
    if not is_storm:
        return _FIRST_NS + int(random.uniform() * (last - _FIRST_NS))
    hours = rc.start_ns[(rc.value < STORM_NT) & (rc.start_ns >= _FIRST_NS) & (rc.start_ns < last)]
    return int(random.choice(hours)) + int(random.uniform() * HOUR_NS) - half_ns


def _plain_scale(samples: Samples, field: str, index: Index | None) -> NDArray[np.float64]:
    found = calibrate(
        samples,
        field=field,
        index=index,
        method="scalar",
        robust="none",
        noise_model="none",
        time_offset="none",
        locked_terms="none",
        bias_steps="none",
        regressors=(),
    )
    return np.asarray(found.parameters.scale)

"""The kinds of missions of the population: each is one entry of `KINDS`, drawn by `draw_kind`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask
from magcal_core.attitude.rotation import from_rotation_vector, multiply, rotate
from magcal_core.field.igrf import MAX_RADIUS_KM
from magcal_core.field.index import Index
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.attitude_modes import MODES, Motion, mounted
from magcal_core.simulation.bias_errors import BIAS_ERRORS, BiasError, everyday
from magcal_core.simulation.electronics import ELECTRONICS, cubic
from magcal_core.simulation.flight import Flight
from magcal_core.simulation.missions import (
    FREE_MOTION,
    MOST_SAMPLES,
    DisturbedField,
    Mission,
    displaced,
    draw_mission,
    draw_orbit,
    draw_sensor,
    draw_transfer_orbit,
)
from magcal_core.simulation.ranges import Draws
from magcal_core.simulation.sample_times import SAMPLE_TIMES

SLOW_MODES: Final = ("nadir", "sun", "spin", "nutating spin", "B-dot", "hysteresis rods", "tumbling")
"""Modes that samples every some seconds can follow."""
INERTIAL_MODES: Final = ("sun", "spin", "nutating spin", "tumbling")
TURNING_MODES: Final = ("spin", "nutating spin", "tumbling")
PARTS: Final = 16
"""Instants over a sampling interval whose mean is its reading."""
SHORTEST_STEP_S: Final = 1.0
LONGEST_STEP_S: Final = 60.0
"""Sampling interval over which a reading is averaged."""


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of missions.

    Attributes
    ----------
    modes : keys of `MODES`, one of which is drawn.
    errors : keys of `BIAS_ERRORS` that all act, beside the everyday wave and drift.
    electronics : key of `ELECTRONICS`, empty for none.
    times : key of `SAMPLE_TIMES`.
    is_transfer : on a geostationary transfer orbit, else on a low one.
    is_averaged : each reading is the mean over its sampling interval.
    is_bent : the response is cubic.
    is_determined : False where no row tells of an axis, so that a refusal is right.
    """

    modes: tuple[str, ...] = SLOW_MODES
    errors: tuple[str, ...] = ()
    electronics: str = ""
    times: str = "steady"
    is_transfer: bool = False
    is_averaged: bool = False
    is_bent: bool = False
    is_determined: bool = True


KINDS: Final[Mapping[str, Kind]] = {
    **{mode: Kind((mode,)) for mode in MODES},
    "eclipse heat": Kind(errors=("heat",)),
    "panel currents": Kind(errors=("panels",)),
    "torquers, not told": Kind(errors=("torquers",)),
    "torquers as regressors": Kind(errors=("told torquers",)),
    "random walk of the bias": Kind(errors=("random walk",)),
    "quantised": Kind(electronics="quantised"),
    "clipped": Kind(electronics="clipped"),
    "averaged over the interval": Kind(TURNING_MODES, is_averaged=True),
    "one axis stuck for a stretch": Kind(electronics="stuck for a stretch"),
    "one axis stuck throughout": Kind(electronics="stuck throughout", is_determined=False),
    "cubic response": Kind(is_bent=True),
    "passes over days": Kind(times="passes"),
    "transfer orbit": Kind(INERTIAL_MODES, is_transfer=True, times="transfer"),
    "sparse in the sun, heat": Kind(errors=("heat",), times="sparse in the sun"),
    "sparse in the sun, heat and panels": Kind(errors=("heat", "panels"), times="sparse in the sun"),
    "heat, walk, quantised": Kind(errors=("heat", "random walk"), electronics="quantised"),
}
KIND_NAMES: Final = (FREE_MOTION, *KINDS)


def draw_kind(name: str, seed: int, index: Index | None = None) -> Mission:
    """Return mission number ``seed`` of the kind ``name``, one of `KIND_NAMES`; no two seeds draw the same.

    The external field is that of some days of the ``index``; without one its hours are drawn.

    Notes
    -----
    Figures come from `RANGES`. Two thirds are calibrated by |B|, half of these with attitude beside; one third by
    vectors. Every mission has noise, a wave and a drift of the bias, dropouts, a TLE of up to 10 days with the error
    that such TLEs have, and two in five have spikes. Options are the defaults.
    """
    if name == FREE_MOTION:
        return draw_mission(seed, index)
    kind, draws = KINDS[name], Draws(np.random.default_rng([seed, *name.encode()]))
    random = draws.random
    start = np.datetime64("2021-01-01T00:00:00", "ns") + np.timedelta64(int(random.uniform(0, 4 * 365.25 * 86400)), "s")
    flight, t_s = _flight(kind, draws, start, index)
    mode = str(random.choice(kind.modes))
    motion = mounted(draws, MODES[mode](draws, flight, float(t_s[-1])))
    if kind.is_averaged:
        t_s = _averaging_times(draws, float(t_s[-1]))
    return _flown(name, seed, _Way(draws, flight, mode, motion, t_s))


def _flight(kind: Kind, draws: Draws, start: np.datetime64, index: Index | None) -> tuple[Flight, Floats]:
    """Return a flight and instants of its samples, s; on another orbit where this one has none such."""
    while True:
        orbit = _orbit(kind, draws, start)
        is_far, random = kind.is_transfer, draws.random
        field = DisturbedField.drawn_far(random) if is_far else DisturbedField.drawn(random, start, index)
        flight = Flight(orbit, field, start)
        t_s = SAMPLE_TIMES[kind.times](draws, flight)
        if t_s is not None:
            return flight, t_s


def _orbit(kind: Kind, draws: Draws, start: np.datetime64) -> Orbit:
    if not kind.is_transfer:
        return draw_orbit(draws.random, start)
    names = ("transfer_perigee_km", "transfer_apogee_km", "transfer_inclination_deg")
    return draw_transfer_orbit(draws.random, start, {name: draws.of(name) for name in names})


def _averaging_times(draws: Draws, duration_s: float) -> Floats:
    """Return instants so far apart that the body turns by the angle that is drawn between two."""
    speed = next(draws.drawn[name] for name in ("spin_deg_s", "tumble_deg_s") if name in draws.drawn)
    step_s = float(np.clip(draws.of("turn_deg") / speed, SHORTEST_STEP_S, LONGEST_STEP_S))
    draws.drawn["interval_s"] = step_s
    return step_s * np.arange(1, 1 + min(MOST_SAMPLES, max(int(duration_s / step_s), 60)), dtype=np.float64)


def averaged_nt(flight: Flight, motion: Motion, t_s: Floats, interval_s: float, parts: int = PARTS) -> Floats:
    """Return the mean of the field in body axes over ``interval_s`` about each instant, shape (n, 3), nT."""
    within_s = interval_s * ((np.arange(parts) + 0.5) / parts - 0.5)
    every_s = (t_s[:, None] + within_s).ravel()
    return np.asarray(rotate(motion(every_s), flight.field_gcrf_nt(every_s)).reshape(len(t_s), parts, 3).mean(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """What a mission is before it is sampled: where it flies, how it turns, when it samples."""

    draws: Draws
    flight: Flight
    mode: str
    motion: Motion
    t_s: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Read:
    """What a sensor makes of a field, and the truth of it; names as in `Mission`."""

    truth: SensorModel
    noise_nt: float
    h_nt: Floats
    is_sound: Mask
    cubic_share: Floats
    errors: list[BiasError]

    @property
    def moved_nt(self) -> Floats:
        """By how much the bias is off beside what regressors tell of, shape (n, 3), nT."""
        told = (np.outer(one.columns[name], nt) for one in self.errors for name, nt in one.told_nt_per_unit.items())
        moved_nt = np.sum([one.moved_nt for one in self.errors], axis=0)
        return np.asarray(moved_nt - sum(told, np.zeros_like(moved_nt)))


def _read(kind: Kind, way: _Way, seen_nt: Floats) -> _Read:
    """Return readings of the field ``seen_nt``, shape (n, 3), nT, body axes."""
    draws, random = way.draws, way.draws.random
    truth, noise_nt = draw_sensor(random), draws.of("noise_nt")
    acting = [everyday, *(BIAS_ERRORS[error] for error in kind.errors)]
    errors = [error(draws, way.flight, way.motion, way.t_s) for error in acting]
    bent = draws.of("cubic_share") * random.uniform(-1.0, 1.0, 3) if kind.is_bent else np.zeros(3)
    moved_nt = np.sum([error.moved_nt for error in errors], axis=0)
    h_nt = cubic(truth.apply(seen_nt) + moved_nt, bent) + noise_nt * random.normal(size=seen_nt.shape)
    h_nt, is_sound = _with_spikes(draws, h_nt)
    if kind.electronics:
        h_nt, tells = ELECTRONICS[kind.electronics](draws, h_nt)
        is_sound &= tells
    return _Read(truth, noise_nt, h_nt, is_sound, bent, errors)


def _flown(name: str, seed: int, way: _Way) -> Mission:
    kind, draws, flight, t_s = KINDS[name], way.draws, way.flight, way.t_s
    q = way.motion(t_s)
    b_base_nt = rotate(q, flight.field_gcrf_nt(t_s))
    seen_nt = averaged_nt(flight, way.motion, t_s, draws.drawn["interval_s"]) if kind.is_averaged else b_base_nt
    read = _read(kind, way, seen_nt)
    is_vector = draws.chance(1 / 3)
    has_attitude = is_vector or draws.chance(0.5)
    arrived = draws.random.random(len(t_s)) >= draws.of("dropped_share")
    columns = {name: column for error in read.errors for name, column in error.columns.items()}
    told = tuple(name for error in read.errors for name in error.told_nt_per_unit)
    sent = _sent(draws, q) if has_attitude else None
    samples = Samples(flight.t_utc(t_s), read.h_nt, sent, housekeeping=columns)
    reference = displaced(draws.random, flight.orbit, flight.start_utc, draws.of("orbit_age_days"))
    return Mission(
        seed,
        name,
        way.mode if has_attitude else f"{way.mode}, no attitude",
        samples.take(arrived),
        (reference,),
        CalibrationOptions(method="vector" if is_vector else "scalar", regressors=told),
        read.truth,
        float(np.hypot(read.noise_nt, draws.drawn.get("step_nt", 0.0) / np.sqrt(12.0))),
        b_base_nt[arrived],
        read.moved_nt[arrived],
        (read.is_sound & _within_reach(flight, t_s, b_base_nt))[arrived],
        flight.light(t_s)[arrived],
        read.cubic_share,
        kind.is_determined,
        dict(draws.drawn),
    )


def _with_spikes(draws: Draws, h_nt: Floats) -> tuple[Floats, Mask]:
    """Return readings, two missions in five with spikes in random directions, and which have none."""
    if not draws.chance(0.4):
        return h_nt, np.ones(len(h_nt), dtype=bool)
    is_spike = draws.random.random(len(h_nt)) < draws.of("spike_share")
    spikes = draws.random.normal(size=h_nt.shape)
    spikes *= draws.of("spike_nt") / np.linalg.norm(spikes, axis=1, keepdims=True)
    return h_nt + is_spike[:, None] * spikes, ~is_spike


def _within_reach(flight: Flight, t_s: Floats, b_nt: Floats) -> Mask:
    """Return where the field model reaches and the field is not less than a twentieth of the largest, shape (n,)."""
    size_nt, radius_km = np.linalg.norm(b_nt, axis=1), np.linalg.norm(flight.state_gcrf(t_s)[0], axis=1)
    return np.asarray((radius_km < MAX_RADIUS_KM) & (size_nt >= size_nt.max() / 20.0))


def _sent(draws: Draws, q: Floats) -> Floats:
    """Return the attitude as the satellite knows it, shape (n, 4)."""
    off_rad = np.deg2rad(draws.of("attitude_noise_deg")) * draws.random.normal(size=(len(q), 3))
    return multiply(q, from_rotation_vector(off_rad))

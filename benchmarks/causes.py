"""Wrong inputs planted in sessions on missions drawn anew: how often the cause that is named first is the right one.

A fault that a calibration mends by itself (an offset of the clock that `time_offset auto` takes) counts as found where
the offset is right. ``MAGCAL_CAUSES`` sets the number of missions of each fault, ``MAGCAL_SEEDS_FROM`` the number that
their seeds begin at.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.measure import Figure
from magcal_core.errors import MagcalError
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.timescales import tai_minus_utc_s
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.simulation.missions import DisplacedOrbit
from tests.magcal_core.fresh import Flown, fresh, fresh_orbit

IS_STUDY = True
ROOM: Final = "causes"
MISSIONS: Final = 8
NONE: Final = "nothing"
MINUTE_S: Final = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Planted:
    """What a station sends: samples and orbit, orbits of other objects, and how it is calibrated.

    ``added_s``: what would have to be added to the clock, s, where that is the fault.
    """

    samples: Samples
    orbit: Orbit
    candidates: tuple[Orbit, ...] = ()
    is_vector: bool = False
    added_s: float | None = None


Fault = Callable[[Flown], Planted]


def _healthy(one: Flown) -> Planted:
    return Planted(one.sent(), one.orbit)


def _later(one: Flown, seconds: float) -> Planted:
    sent = one.sent()
    moved = replace(sent, t_utc=sent.t_utc + np.timedelta64(round(seconds * 1e9), "ns"))
    return Planted(moved, one.orbit, added_s=-seconds)


def _local_time(one: Flown) -> Planted:
    return _later(one, 3600.0 * float(one.random.choice([-11, -8, -5, -3, 1, 2, 3, 5.5, 9, 10, 12])))


def _clock(low_s: float, high_s: float) -> Fault:
    def plant(one: Flown) -> Planted:
        size_s = float(np.exp(one.random.uniform(np.log(low_s), np.log(high_s))))
        return _later(one, size_s * float(one.random.choice([-1.0, 1.0])))

    return plant


def _gps_time(one: Flown) -> Planted:
    return _later(one, float(tai_minus_utc_s(one.samples.t_utc[:1])[0]) - 19.0)


def _another_satellite(*, is_known: bool) -> Fault:
    def plant(one: Flown) -> Planted:
        start = one.samples.t_utc[0]
        others = tuple(fresh_orbit(one.random, start) for _ in range(3))
        return Planted(one.sent(), others[0], (others[1], one.orbit, others[2]) if is_known else others[1:])

    return plant


def _along(one: Flown) -> Planted:
    away_s = float(one.random.uniform(240.0, 1800.0)) * float(one.random.choice([-1.0, 1.0]))
    return Planted(one.sent(), DisplacedOrbit(one.orbit, one.samples.t_utc[0], 0.0, away_s, 0.0))


def _readings(change: Callable[[Flown], np.ndarray]) -> Fault:
    return lambda one: Planted(one.sent(replace(one.samples, h_nt=change(one))), one.orbit)


def _axis_still(one: Flown) -> np.ndarray:
    h, axis = one.samples.h_nt.copy(), int(one.random.integers(3))
    h[:, axis] = h[0, axis]
    return h


def _axis_of_noise(one: Flown) -> np.ndarray:
    h, axis = one.samples.h_nt.copy(), int(one.random.integers(3))
    h[:, axis] = one.random.uniform(-2e4, 2e4) + 100.0 * one.random.normal(size=len(h))
    return h


def _still(one: Flown) -> np.ndarray:
    return np.asarray(one.samples.h_nt[0] + 50.0 * one.random.normal(size=one.samples.h_nt.shape))


def _noise(one: Flown) -> np.ndarray:
    return np.asarray(one.random.normal(scale=3e4, size=one.samples.h_nt.shape))


def _axes(change: Callable[[Flown, np.ndarray], np.ndarray]) -> Fault:
    def plant(one: Flown) -> Planted:
        samples = replace(one.samples, h_nt=np.ascontiguousarray(change(one, one.samples.h_nt.copy())))
        return Planted(one.sent(samples, is_vector=True), one.orbit, is_vector=True)

    return plant


def _swapped(one: Flown, h: np.ndarray) -> np.ndarray:
    a = int(one.random.integers(3))
    pair = [a, (a + 1) % 3]
    h[:, pair] = h[:, pair[::-1]]
    return h


def _inverted(one: Flown, h: np.ndarray) -> np.ndarray:
    h[:, int(one.random.integers(3))] *= -1.0
    return h


def _attitude(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def plant(one: Flown) -> Planted:
        q = one.samples.q_base_gcrf
        sent = one.sent(is_vector=True)
        return Planted(replace(sent, q_base_gcrf=None if q is None else change(q)), one.orbit, is_vector=True)

    return plant


FAULTS: Mapping[str, tuple[tuple[str, ...], Fault]] = {
    "healthy": ((NONE,), _healthy),
    "local time": (("clock",), _local_time),
    "clock off by 200 s to a day": (("clock",), _clock(200.0, 86_000.0)),
    "clock off by 30 to 60 s": (("clock",), _clock(30.0, 60.0)),
    "GPS time": (("clock",), _gps_time),
    "another satellite, its TLE among the candidates": (("wrong_satellite",), _another_satellite(is_known=True)),
    "another satellite": (("unexplained", "orbit_plane"), _another_satellite(is_known=False)),
    "place along the track": (("along_track", "clock"), _along),
    "unit: 100 times": (("unit",), _readings(lambda one: 100.0 * one.samples.h_nt)),
    "unit: uT for nT": (("unit",), _readings(lambda one: 1e-3 * one.samples.h_nt)),
    "unit: nT for mG": (("unit",), _readings(lambda one: 1e-2 * one.samples.h_nt)),
    "axis constant": (("axis_constant",), _readings(_axis_still)),
    "axis of noise": (("axis_constant",), _readings(_axis_of_noise)),
    "sensor constant": (("sensor_constant",), _readings(_still)),
    "noise for a sensor": (("unexplained",), _readings(_noise)),
    "rows shuffled": (("unexplained",), _readings(lambda one: one.random.permutation(one.samples.h_nt))),
    "axes swapped": (("frame_suspect",), _axes(_swapped)),
    "axis inverted": (("frame_suspect",), _axes(_inverted)),
    "quaternion of the inverse turn": (("frame_suspect",), _attitude(lambda q: q * [1.0, -1.0, -1.0, -1.0])),
    "quaternion with its scalar last": (("frame_suspect",), _attitude(lambda q: np.roll(q, -1, axis=1))),
}
"""Fault -> the causes that are right to be named first, and how it is planted."""
_OF_AXES: Final = "frame_suspect"


def first_cause(given: Planted) -> str:
    """Return the code of the cause that is named first; "nothing" where none is."""
    method = "vector" if given.is_vector else "scalar"
    try:
        found = calibrate(given.samples, [given.orbit], candidates=given.candidates, method=method)
    except MagcalError as error:
        said = str(error)
        if _OF_AXES in said or "seem to be" in said:
            return _OF_AXES
        findings = (error.diagnosis or {}).get("findings")
        return str(findings[0]["code"]) if isinstance(findings, list) and findings else f"{error.code}, no cause"
    diagnosis = found.extras["diagnosis"]
    if isinstance(diagnosis, dict) and diagnosis["findings"]:
        return str(diagnosis["findings"][0]["code"])
    suspected = found.extras["suspicions"]
    if isinstance(suspected, list) and any(one["code"] == _OF_AXES for one in suspected):
        return _OF_AXES
    offset_s = found.parameters.time_offset_s
    if given.added_s is not None and offset_s is not None and abs(offset_s - given.added_s) < 1.5:
        return "clock"
    return NONE


def figures() -> Iterator[Figure]:
    """Yield, of every fault, how often the first cause is a right one, and what was named in its place."""
    missions = int(os.environ.get("MAGCAL_CAUSES", MISSIONS))
    first = int(os.environ.get("MAGCAL_SEEDS_FROM", "5000"))
    for number, (name, (right, plant)) in enumerate(FAULTS.items()):
        named = Counter(first_cause(plant(fresh(first + 100 * number + i))) for i in range(missions))
        share = 100.0 * sum(named[code] for code in right) / missions
        note = ", ".join(f"{code} {count}" for code, count in named.most_common())
        yield Figure(ROOM, f"{name}: the right cause first", share, "%", ">= 90", share >= 90.0, note)

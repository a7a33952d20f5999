"""Causes that lie in clock or orbit: scans of what the field would be with another clock, place or object.

Notes
-----
|B| hardly separates a clock from a place along the track below some minutes, and an orbit that repeats its ground track
hides a shift of one day: hence several minima of each scan are refined, and time zones go first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.diagnosis.explanation import Explanation, Rows
from magcal_core.calibration.estimators.many_references import median_residuals
from magcal_core.errors import MagcalError
from magcal_core.field import FieldModel
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit import Orbit

EARTH_RAD_S: Final = 7.292115e-5
DAY_S: Final = 86400.0
_GRID_S: Final = 30.0
_APART_S: Final = 300.0
_MINIMA: Final = 6
_HALF_HOUR_S: Final = 1800.0
_ZONES: Final = 2
FARTHEST_ZONE_S: Final = 14 * 3600.0
"""Time zones lie within 14 h of UTC."""
_ALONG_S: Final = 120.0
_NODE_DEG: Final = 6.0
_AT_ONCE: Final = 1024


@dataclass(frozen=True, slots=True)
class OrbitCandidate:
    """Another reference: what kind it is, its figures, s and deg, its name, and how well it explains the rows."""

    kind: str
    offset_s: float
    node_deg: float
    name: str
    explanation: Explanation


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where an orbit has the satellite at the times ``t_utc``, shape (m,), of the rows, and a field model."""

    orbit: Orbit
    t_utc: Times
    field: FieldModel

    def field_nt(self, offset_s: Floats, turn_rad: Floats | None = None, field: FieldModel | None = None) -> Floats:
        """Return |B|, shape (c, m), nT, at ``t_utc`` + offset, the positions turned eastwards by ``turn_rad``, (c,)."""
        times = self.t_utc + np.round(offset_s * 1e9).astype("timedelta64[ns]")[:, None]
        flat = times.ravel()
        order = np.argsort(flat, kind="stable")
        r_km = np.empty((flat.size, 3))
        r_km[order] = self.orbit.position_itrf_km(flat[order])
        if turn_rad is not None:
            angle = np.repeat(turn_rad, len(self.t_utc))
            c, s = np.cos(angle), np.sin(angle)
            r_km[:, :2] = np.column_stack([c * r_km[:, 0] - s * r_km[:, 1], s * r_km[:, 0] + c * r_km[:, 1]])
            flat = np.broadcast_to(self.t_utc, times.shape).ravel()
        model = self.field if field is None else field
        return lengths(np.ascontiguousarray(model.field_itrf_nt(flat, r_km))).reshape(times.shape)


def other_clocks(rows: Rows, track: Track) -> list[OrbitCandidate]:
    """Return the clocks, within a day, that explain the rows best: one grid of |B|, interpolated by four points."""
    seconds = (track.t_utc - track.t_utc[0]) / np.timedelta64(1, "ns") * 1e-9
    first, last = -DAY_S - 2 * _GRID_S, float(seconds[-1]) + DAY_S + 3 * _GRID_S
    grid_s = np.arange(first, last, _GRID_S)
    start = Track(track.orbit, track.t_utc[:1], track.field)
    grid_nt = start.field_nt(grid_s)[:, 0]

    def field_nt(offset_s: Floats) -> Floats:
        place = (seconds + offset_s[:, None] - first) / _GRID_S
        whole = np.clip(np.floor(place).astype(np.intp), 1, len(grid_nt) - 3)
        u = place - whole
        before, here, after, beyond = (grid_nt[whole + k] for k in (-1, 0, 1, 2))
        return np.asarray(
            -u * (u - 1) * (u - 2) / 6 * before
            + (u + 1) * (u - 1) * (u - 2) / 2 * here
            - (u + 1) * u * (u - 2) / 2 * after
            + (u + 1) * u * (u - 1) / 6 * beyond
        )

    steps = round(DAY_S / _GRID_S)
    offsets_s = np.asarray(_GRID_S * np.arange(-steps, steps + 1), np.float64)
    scores = _scored(rows, offsets_s, field_nt)
    found = []
    for offset_s in dict.fromkeys([*_minima(offsets_s, scores), *_zones(offsets_s, scores)]):
        best_s = _refined(rows, field_nt, offset_s, _GRID_S, 0.3)
        exact_nt = track.field_nt(np.array([best_s]))[0]
        found.append(OrbitCandidate("clock", best_s, 0.0, "", rows.explanation(exact_nt)))
    return found


def along_the_track(rows: Rows, track: Track, period_s: float) -> list[OrbitCandidate]:
    """Return the places along the track, half a period each way, with the Earth turned back under them."""

    def field_nt(offset_s: Floats) -> Floats:
        return track.field_nt(offset_s, EARTH_RAD_S * offset_s)

    offsets_s = np.arange(-period_s / 2.0, period_s / 2.0, _ALONG_S)
    scores = _scored(rows, offsets_s, field_nt)
    found = []
    for offset_s in _minima(offsets_s, scores, most=3):
        best_s = _refined(rows, field_nt, offset_s, _ALONG_S, 1.0)
        found.append(OrbitCandidate("along_track", best_s, 0.0, "", rows.explanation(field_nt(np.array([best_s]))[0])))
    return found


def other_planes(rows: Rows, track: Track, period_s: float, coarse: FieldModel) -> list[OrbitCandidate]:
    """Return the planes and places in them that explain the rows best; ``coarse``: a field of low degree."""
    offsets_s, nodes = np.meshgrid(
        np.arange(-period_s / 2.0, period_s / 2.0, _ALONG_S), np.arange(-180.0, 180.0, _NODE_DEG), indexing="ij"
    )
    flat_s, flat_deg = offsets_s.ravel(), nodes.ravel()
    scores = np.concatenate(
        [
            median_residuals(rows.quadric, track.field_nt(flat_s[i], _turn(flat_s[i], flat_deg[i]), coarse))
            for i in np.array_split(np.arange(flat_s.size), max(1, flat_s.size // _AT_ONCE))
        ]
    )
    found, taken = [], np.zeros(scores.size, dtype=bool)
    for i in np.argsort(scores):
        near = np.abs((flat_deg - flat_deg[i] + 180.0) % 360.0 - 180.0) <= 3 * _NODE_DEG
        if taken[near & (np.abs(flat_s - flat_s[i]) <= 3 * _ALONG_S)].any():
            continue
        taken[i] = True
        found.append(_refined_plane(rows, track, float(flat_s[i]), float(flat_deg[i])))
        if len(found) == 4:
            break
    return found


def _turn(offset_s: Floats, node_deg: Floats) -> Floats:
    return EARTH_RAD_S * offset_s + np.deg2rad(node_deg)


def _refined_plane(rows: Rows, track: Track, offset_s: float, node_deg: float) -> OrbitCandidate:
    step_s, step_deg = _ALONG_S, _NODE_DEG
    ways = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)], dtype=np.float64)
    while step_s > 0.5:
        tried_s, tried_deg = offset_s + step_s * ways[:, 0], node_deg + step_deg * ways[:, 1]
        best = int(np.argmin(median_residuals(rows.quadric, track.field_nt(tried_s, _turn(tried_s, tried_deg)))))
        if best == len(ways) // 2:
            step_s, step_deg = step_s / 2.0, step_deg / 2.0
        offset_s, node_deg = float(tried_s[best]), float(tried_deg[best])
    here = np.array([offset_s]), _turn(np.array([offset_s]), np.array([node_deg]))
    return OrbitCandidate("orbit_plane", offset_s, node_deg, "", rows.explanation(track.field_nt(*here)[0]))


def other_objects(
    rows: Rows, t_utc: Times, field: FieldModel, named: Sequence[tuple[str, Orbit]]
) -> list[OrbitCandidate]:
    """Return how well the orbits of other objects explain the rows; those that do not reach so far are passed over."""
    found = []
    for name, orbit in named:
        try:
            b_nt = Track(orbit, t_utc, field).field_nt(np.zeros(1))[0]
        except MagcalError:
            continue
        found.append(OrbitCandidate("wrong_satellite", 0.0, 0.0, name, rows.explanation(b_nt)))
    return found


def _scored(rows: Rows, offsets_s: Floats, field_nt: Callable[[Floats], Floats]) -> Floats:
    parts = np.array_split(offsets_s, max(1, len(offsets_s) // _AT_ONCE))
    return np.concatenate([median_residuals(rows.quadric, field_nt(part)) for part in parts])


def _minima(offsets_s: Floats, scores: Floats, most: int = _MINIMA) -> list[float]:
    """Return the best offsets, at least `_APART_S` from one another."""
    found: list[float] = []
    for i in np.argsort(scores):
        if all(abs(offsets_s[i] - one) >= _APART_S for one in found):
            found.append(float(offsets_s[i]))
        if len(found) == most:
            break
    return found


def _zones(offsets_s: Floats, scores: Floats) -> list[float]:
    """Return the best offsets by whole half hours up to 14 h, which a short session may hide behind better minima."""
    is_zone = (offsets_s % _HALF_HOUR_S == 0.0) & (offsets_s != 0.0) & (np.abs(offsets_s) <= FARTHEST_ZONE_S)
    order = np.argsort(np.where(is_zone, scores, np.inf))
    return [float(offsets_s[i]) for i in order[:_ZONES]]


def _refined(rows: Rows, field_nt: Callable[[Floats], Floats], offset_s: float, step_s: float, last_s: float) -> float:
    """Return the best offset near ``offset_s``, by ever narrower combs."""
    while step_s > last_s / 2.0:
        comb = offset_s + step_s * np.linspace(-1.0, 1.0, 9)
        offset_s = float(comb[int(np.argmin(median_residuals(rows.quadric, field_nt(comb))))])
        step_s /= 4.0
    return offset_s

"""The causes in their order: rows and axes first, then orbits and clocks; the first that holds ends the search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.diagnosis.cause import Diagnosis, Finding, Named, Tried
from magcal_core.calibration.diagnosis.explanation import BETTER, EXPLAINED, MOST, Explanation, Rows
from magcal_core.calibration.diagnosis.other_orbits import (
    FARTHEST_ZONE_S,
    OrbitCandidate,
    Track,
    along_the_track,
    other_clocks,
    other_objects,
    other_planes,
)
from magcal_core.calibration.diagnosis.rows_and_axes import (
    BAD_SHARE,
    bad_rows,
    constant_axis,
    constant_sensor,
    wrong_unit,
)
from magcal_core.calibration.estimators.loss import CLEAN_SHARE, WORTH_A_LOOK
from magcal_core.calibration.estimators.robust_start import rows_looked_at
from magcal_core.errors import MagcalError, OptionError
from magcal_core.field import FieldModel
from magcal_core.field.models import field_model
from magcal_core.orbit import Orbit
from magcal_core.samples import Samples

MOST_ROWS: Final = 300
FEWEST_ROWS: Final = 25
"""Rows below which ten unknowns explain anything."""
_MOST_ROWS_GOOD: Final = 0.7
"""Share of the rows below which smooth residuals of the others say that the reference is wrong, not the rows."""
_QUARTER_HOUR_S: Final = 900.0
_ZONE_S: Final = 20.0
_SHORT_CLOCK_S: Final = 1500.0
_COARSE_DEGREE: Final = 6


@dataclass(frozen=True, slots=True, eq=False)
class Circumstances:
    """What a diagnosis may look at: samples with their reference, the orbit, the field, and orbits of other objects."""

    samples: Samples
    orbit: Orbit | None
    field: FieldModel
    others: Sequence[tuple[str, Orbit]] = ()


def diagnosis_of(given: Circumstances) -> Diagnosis:
    """Return what is wrong with the samples; nothing is applied."""
    samples, b_all = given.samples, given.samples.b_ref_magnitude_nt
    if b_all is None:
        return Diagnosis(None, None)
    index = np.flatnonzero(samples.is_used & np.isfinite(b_all) & (b_all > 0))
    h_nt, b_nt, t_utc = samples.h_nt[index], b_all[index], samples.t_utc[index]
    duration_s = float((t_utc[-1] - t_utc[0]) / np.timedelta64(1, "s")) if len(index) else 0.0
    for found in (
        constant_sensor(samples, h_nt, b_nt, duration_s),
        constant_axis(h_nt, b_nt),
        wrong_unit(h_nt, b_nt),
    ):
        if found is not None:
            return Diagnosis(None, None, (found,))
    if len(index) < FEWEST_ROWS:
        return Diagnosis(None, None)
    few = rows_looked_at(len(index), MOST_ROWS)
    rows = Rows.of(h_nt[few])
    explanation = rows.explanation(b_nt[few])
    return _behind(given, rows, explanation, t_utc[few])


def _behind(given: Circumstances, rows: Rows, own: Explanation, t_utc: NDArray[np.datetime64]) -> Diagnosis:
    """Return what is behind a residual that rows and axes do not explain by themselves."""
    bad = bad_rows(given.samples, 1.0 - own.inlier_share) if own.scale < EXPLAINED else None
    figures = (own.scale if np.isfinite(own.scale) else None, own.inlier_share)
    # Of a wrong reference the best half of the rows may show a sensor as well: many far rows are worth a look too.
    is_suspect = bad is not None and 1.0 - own.inlier_share > BAD_SHARE
    is_settled = bad is not None and own.is_settled
    if is_settled or (own.scale < WORTH_A_LOOK and not is_suspect):
        return Diagnosis(*figures, () if bad is None else (bad,))
    candidates = _candidates(given, rows, t_utc)
    tried = tuple(Tried(one.kind, _text(one), one.explanation.scale) for one in _best_of_each(candidates))
    explaining = [one for one in candidates if one.explanation.explains(own)]
    if explaining:
        return Diagnosis(*figures, (_finding(explaining, own),), tried)
    is_half = bad is not None and own.is_coloured and _is_part(own)
    if bad is not None and not is_half:
        return Diagnosis(*figures, (bad,), tried)
    if own.scale <= EXPLAINED and not is_half:
        return Diagnosis(*figures, (), tried)
    found = Finding("unexplained", _unexplained(own, is_half=is_half), figures[0], "share of the field", None)
    return Diagnosis(*figures, (found,), tried)


def _is_part(own: Explanation) -> bool:
    """Return whether a sensor explains so few rows, or explains them so badly, that the others need not be bad."""
    return own.inlier_share < (_MOST_ROWS_GOOD if own.scale < CLEAN_SHARE else MOST)


def _unexplained(own: Explanation, *, is_half: bool) -> str:
    if is_half:
        return (
            f"a sensor explains {own.inlier_share:.0%} of the rows, and what these leave is no noise: the reference is "
            "wrong, but no other clock or orbit that was tried explains the readings"
        )
    if not np.isfinite(own.scale):
        return "no sensor explains the readings, and no other clock or orbit that was tried does"
    return (
        f"the best sensor leaves {own.scale:.1%} of the field, and no other clock or orbit that was tried leaves less"
    )


def _candidates(given: Circumstances, rows: Rows, t_utc: NDArray[np.datetime64]) -> list[OrbitCandidate]:
    """Return the best of every scan; an orbit that does not reach so far is not scanned so far."""
    found = other_objects(rows, t_utc, given.field, given.others)
    if given.orbit is None:
        return found
    track = Track(given.orbit, t_utc, given.field)
    try:
        found += other_clocks(rows, track)
        period_s = period_of(given.orbit, t_utc[0])
        found += along_the_track(rows, track, period_s)
        if not any(one.explanation.is_sound for one in found):
            found += other_planes(rows, track, period_s, _coarse(given.field))
    except MagcalError:
        return found
    return found


def _coarse(field: FieldModel) -> FieldModel:
    try:
        return field_model(field.name, _COARSE_DEGREE)
    except OptionError:
        return field


def period_of(orbit: Orbit, at: np.datetime64) -> float:
    """Return the period of ``orbit``, s, from its radius and speed at a time (vis viva)."""
    r_km, v_km_s = orbit.state_gcrf(np.array([at]))
    radius, speed = float(np.linalg.norm(r_km)), float(np.linalg.norm(v_km_s))
    axis_km = 1.0 / (2.0 / radius - speed**2 / 398600.4418)
    return float(2.0 * np.pi * np.sqrt(axis_km**3 / 398600.4418))


def _best_of_each(candidates: Sequence[OrbitCandidate]) -> list[OrbitCandidate]:
    kinds = dict.fromkeys(one.kind for one in candidates)
    of_each = [[one for one in candidates if one.kind == kind and np.isfinite(one.explanation.scale)] for kind in kinds]
    return [min(some, key=lambda one: one.explanation.capped) for some in of_each if some]


def _finding(explaining: Sequence[OrbitCandidate], own: Explanation) -> Finding:
    """Return the cause that goes first among those that explain the rows about as well as the best one."""
    least = min(one.explanation.capped for one in explaining)
    near = [one for one in explaining if one.explanation.capped <= BETTER * least]
    near.sort(key=lambda one: (_rank(one), one.explanation.capped))
    first = near[0]
    alternatives = tuple(Named(one.kind, _text(one)) for one in near[1:])
    value: float | str | None = first.offset_s if first.kind != "wrong_satellite" else first.name
    unit = "s" if first.kind != "wrong_satellite" else None
    ratio = own.capped / max(first.explanation.capped, 1e-12)
    return Finding(first.kind, _text(first), value, unit, ratio, alternatives)


def _is_zone(offset_s: float) -> bool:
    quarters = round(offset_s / _QUARTER_HOUR_S)
    is_near = abs(offset_s - quarters * _QUARTER_HOUR_S) <= _ZONE_S
    return quarters != 0 and is_near and abs(offset_s) <= FARTHEST_ZONE_S + _ZONE_S


def _rank(one: OrbitCandidate) -> int:
    if one.kind == "wrong_satellite":
        return 0
    if one.kind == "clock":
        return 1 if _is_zone(one.offset_s) else 2 if abs(one.offset_s) < _SHORT_CLOCK_S else 4
    return {"along_track": 3, "orbit_plane": 5}[one.kind]


def _text(one: OrbitCandidate) -> str:
    if one.kind == "wrong_satellite":
        return f"the orbit of {one.name} explains the readings: give that TLE"
    if one.kind == "clock" and _is_zone(one.offset_s):
        return (
            f"{one.offset_s:.0f} s, local time taken for UTC? Add that to the times, or say so with --time-scale "
            "and the zone of the times"
        )
    if one.kind == "clock":
        return (
            f"{one.offset_s:.1f} s must be added to the telemetry's clock, or the satellite is so far along its track: "
            "--time-offset estimate, --time-scale, or a newer TLE"
        )
    if one.kind == "along_track":
        return f"the satellite is {one.offset_s:.0f} s along its track from where the orbit has it: another TLE?"
    return (
        f"the orbit's plane is turned by {one.node_deg:.0f} deg and the satellite {one.offset_s:.0f} s along its "
        "track: the TLE of another object?"
    )

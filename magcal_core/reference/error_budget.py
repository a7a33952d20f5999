"""Reference error budget: how wrong the computed field may be, so that the sensor is not blamed for the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.constants import EARTH_RADIUS_MAGNETIC_KM, EARTH_ROTATION_RAD_S
from magcal_core.errors import ModelRangeError
from magcal_core.field import FieldModel
from magcal_core.field.external_knowledge import ExternalKnowledge
from magcal_core.field.file_model import FileField
from magcal_core.field.igrf import MAX_DEGREE
from magcal_core.field.summed import SummedField
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit.earth.eop import earth_orientation, ut1_prediction_error_s
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.samples import Samples

EPOCH_ERROR_KM: Final = 0.64
"""Error of a TLE at its epoch, km: what a fit of SGP4 to two days of a full force model leaves."""
DRIFT_KM_PER_DAY: Final = 1.5
"""Growth of the along-track error of a TLE, km/day: 1 to 2 in the first days."""
DRAG_KM_PER_DAY2: Final = 0.2
"""Quadratic growth, km/day^2, from drag: 240 km after 33 days on a real satellite at 550 km, 31 s of flight."""
NUMERICAL_KM_PER_DAY: Final = 5.0
"""Growth when a single SGP4 state is integrated: its energy error runs away, 7 to 11 km at most in a day."""
RADIAL_KM: Final = 0.15
CROSS_TRACK_KM: Final = 0.3
EPHEMERIS_KM: Final = 0.1
"""Error assumed of an OEM, km: operators' own ephemerides."""
GNSS_KM: Final = 0.02
UNSEEN_CLOCK_S: Final = 0.5
"""Clock offset, s, below which a calibration does not see it for certain."""
PREDICTION_NT_PER_YEAR: Final = 8.0
"""Growth of a predicted field's error, nT a year: IGRF-13 was 16 to 17 nT off IGRF-14 in 2022."""
CRUST_NT2_PER_DEGREE: Final = 20.0
"""Power of each degree above 13 at the Earth's surface, nT^2: nearly flat in models of the crust [MAUS]_."""
BESIDE_MAGNITUDE_NT: Final = 2.0
BESIDE_COMPONENT_NT: Final = 3.0
"""External field that no index tells of, nT, in |B| and in a component: ionosphere and field-aligned currents."""
EXTERNAL_MAGNITUDE_NT: Final = 22.0
EXTERNAL_COMPONENT_NT: Final = 18.0
"""All external field, nT, rms of |B| and of a component over 2015 to 2026, where no place is known [CHAOS]_."""

_PLACES: Final = 64
_STEP_KM: Final = 5.0
_TURN_RAD: Final = 1e-3
_MOST_STEP: Final = np.timedelta64(300, "s")


@dataclass(frozen=True, slots=True)
class BudgetItem:
    """One source of error of the reference: root mean square over the samples, nT (None: not known), and why."""

    source: str
    rms_nt: float | None
    why: str

    def to_dict(self) -> dict[str, object]:
        """Return the item as the records of the service have it."""
        return {"source": self.source, "rms_nt": self.rms_nt, "why": self.why}


@dataclass(frozen=True, slots=True)
class ReferenceSource:
    """Where the reference came from.

    Attributes
    ----------
    orbit_model : as in `ReferenceReport`.
    orbit_age_days : largest distance between the data and an orbit's epoch, days.
    field : the model that the field was computed with.
    is_vector : whether components count, or |B| only.
    clock_error_s : standard error of an estimated clock offset, s; None where none was estimated.
    interpolation_km : how far an ephemeris is off between its points at the most, km.
    external : what is known of the external field; None: what the model itself tells.
    """

    orbit_model: str
    orbit_age_days: float
    field: FieldModel
    is_vector: bool = False
    clock_error_s: float | None = None
    interpolation_km: float = 0.0
    external: ExternalKnowledge | None = None

    @property
    def known(self) -> ExternalKnowledge:
        """What is known of the external field."""
        return ExternalKnowledge.of(self.field) if self.external is None else self.external


def error_budget(
    samples: Samples,
    source: ReferenceSource,
    residual_rms_nt: float | None = None,
    *,
    beside: Sequence[BudgetItem] = (),
) -> tuple[BudgetItem, ...]:
    """Return the error budget of the reference of ``samples``, with the total as its last item.

    All figures are of |B|, or root mean squares over the three components where ``source.is_vector``.
    ``residual_rms_nt`` is what the calibration left, nT: the total says how much of it the reference explains.
    ``beside``: what else is wrong with it.
    """
    items = [*_positional(samples, source), *_sources(samples, source), *beside]
    if source.is_vector:
        items.append(
            BudgetItem("attitude", None, "not known here; 0.1 deg are 0.14 % of the field a component, 57 nT at 40 uT")
        )
    known = [item.rms_nt for item in items if item.rms_nt is not None]
    total = float(np.sqrt(np.sum(np.square(known))))
    why = "root sum of squares of what is known"
    if residual_rms_nt is not None and residual_rms_nt > 0:
        why += (
            f"; {min(1.0, (total / residual_rms_nt) ** 2):.0%} of the residual's mean square ({residual_rms_nt:.1f} nT)"
        )
    return (*items, BudgetItem("total", total, why))


# ------------------------------------------------------------------------------------------------------- position


@dataclass(frozen=True, slots=True, eq=False)
class _Gradients:
    """Change of the field per km along track, radially and across, root mean square, and the speed, km/s."""

    along: float
    radial: float
    across: float
    speed_km_s: float


def _positional(samples: Samples, source: ReferenceSource) -> Iterator[BudgetItem]:
    """Yield what errors of position and clock do, where the field was computed at a position."""
    if samples.r_itrf_km is None:
        yield BudgetItem("orbit", None, "the reference came with the telemetry: its own orbit and clock are not known")
        return
    found = _gradients(samples, source)
    if found is None:
        yield BudgetItem("orbit", None, "too few positions in a row to tell the field's gradient")
        return
    along_km, how = along_track_km(samples, source)
    radial_km, across_km = _other_km(source.orbit_model)
    yield BudgetItem(
        "orbit_along_track", found.along * along_km, f"{along_km:.2g} km ({how}) x {found.along:.2g} nT/km"
    )
    if source.interpolation_km > 0.0:
        every = float(np.sqrt((found.along**2 + found.radial**2 + found.across**2) / 3.0))
        yield BudgetItem(
            "orbit_interpolation",
            every * source.interpolation_km / np.sqrt(2.0),
            f"up to {source.interpolation_km:.2g} km between the points of the ephemeris x {every:.2g} nT/km",
        )
    others = float(np.hypot(found.radial * radial_km, found.across * across_km))
    yield BudgetItem(
        "orbit_radial_and_cross_track",
        others,
        f"{radial_km:g} km x {found.radial:.2g} nT/km up, {across_km:g} km x {found.across:.2g} nT/km across",
    )
    if source.orbit_model != "telemetry-position":
        rate = found.along * found.speed_km_s
        is_known = source.clock_error_s is not None
        clock_s = source.clock_error_s if source.clock_error_s is not None else UNSEEN_CLOCK_S
        how = "standard error of the estimated offset" if is_known else "the largest offset that stays unseen"
        yield BudgetItem("clock", rate * clock_s, f"{clock_s:.2g} s ({how}) x {rate:.2g} nT/s")
        yield from _earth_orientation(samples, source)


def _earth_orientation(samples: Samples, source: ReferenceSource) -> Iterator[BudgetItem]:
    """Yield what an error of predicted UT1 does, which turns the Earth under the orbit."""
    days, places = earth_orientation().predicted_days(samples.t_utc), _places(samples)
    if days <= 0.0 or places is None:
        return
    t_utc, r_km, _ = places
    eastward_km = _TURN_RAD * np.cross([0.0, 0.0, 1.0], r_km)
    ahead, behind = (source.field.field_itrf_nt(t_utc, r_km + sign * eastward_km) for sign in (1.0, -1.0))
    per_rad = _difference_nt(ahead, behind, is_vector=source.is_vector) / (2.0 * _TURN_RAD)
    error_s = ut1_prediction_error_s(days)
    turn_rad = EARTH_ROTATION_RAD_S * error_s
    why = f"UT1 predicted for {days:.0f} d, {1e3 * error_s:.1f} ms, {1e6 * turn_rad:.2g} urad of turn"
    yield BudgetItem("earth_orientation", per_rad * turn_rad, why)


def _gradients(samples: Samples, source: ReferenceSource) -> _Gradients | None:
    places = _places(samples)
    if places is None:
        return None
    t_utc, r_km, v_km_s = places
    speed = np.linalg.norm(v_km_s, axis=1, keepdims=True)
    along = v_km_s / speed
    up = r_km / np.linalg.norm(r_km, axis=1, keepdims=True)
    across = np.cross(up, along)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # All in one call: for so few places the field's own time is that of being asked.
    steps = _STEP_KM * np.stack([along, -along, up, -up, across, -across])
    try:
        b_nt = source.field.field_itrf_nt(np.tile(t_utc, len(steps)), (r_km + steps).reshape(-1, 3))
    except ModelRangeError:
        return None
    sides = b_nt.reshape(len(steps), -1, 3)
    by_along, by_up, by_across = (
        _difference_nt(ahead, behind, is_vector=source.is_vector) / (2 * _STEP_KM)
        for ahead, behind in zip(sides[::2], sides[1::2], strict=True)
    )
    return _Gradients(by_along, by_up, by_across, float(np.sqrt(np.mean(speed**2))))


def _difference_nt(one: Floats, other: Floats, *, is_vector: bool) -> float:
    """Return the root mean square difference of |B|, or of a component, nT, of fields of shape (n, 3)."""
    if is_vector:
        return float(np.sqrt(np.mean((one - other) ** 2)))
    return float(np.sqrt(np.mean((np.linalg.norm(one, axis=1) - np.linalg.norm(other, axis=1)) ** 2)))


def _places(samples: Samples) -> tuple[Times, Floats, Floats] | None:
    """Return some times, positions, km, and inertial velocities along ITRF's axes, km/s, that stand for all samples."""
    if samples.r_itrf_km is None:
        return None
    placed = samples.is_used & np.isfinite(samples.r_itrf_km).all(axis=1)
    t_utc, r_km = samples.t_utc, samples.r_itrf_km
    if not placed.all():
        t_utc, r_km = t_utc[placed], r_km[placed]
    before = np.flatnonzero(_is_close(t_utc[2:] - t_utc[:-2]))
    middle = before[:: max(1, len(before) // _PLACES)] + 1
    if len(middle) < 2:
        return None
    step_s = (t_utc[middle + 1] - t_utc[middle - 1]) / np.timedelta64(1, "ns") * 1e-9
    v_km_s = (r_km[middle + 1] - r_km[middle - 1]) / step_s[:, None]
    v_km_s += np.cross([0.0, 0.0, EARTH_ROTATION_RAD_S], r_km[middle])
    return t_utc[middle], r_km[middle], v_km_s


def _is_close(step: NDArray[np.timedelta64]) -> NDArray[np.bool_]:
    """Return which steps, shape (n,), are of time, but not none, and short enough to take a velocity over."""
    return np.asarray((step > np.timedelta64(0)) & (step <= _MOST_STEP))


def along_track_km(samples: Samples, source: ReferenceSource) -> tuple[float, str]:
    """Return the along-track error, km, and what it was taken from."""
    age = source.orbit_age_days
    if source.orbit_model == "telemetry-position":
        return GNSS_KM, "positions of the telemetry"
    if source.orbit_model == "oem":
        return EPHEMERIS_KM, "ephemeris"
    is_numerical = "numerical" in source.orbit_model
    if source.clock_error_s is not None:
        span_days = float((samples.t_utc[-1] - samples.t_utc[0]) / np.timedelta64(1, "s")) / 86400.0
        rate = NUMERICAL_KM_PER_DAY if is_numerical else DRIFT_KM_PER_DAY + 2.0 * DRAG_KM_PER_DAY2 * age
        left_km = rate * span_days / np.sqrt(12.0)
        return float(np.hypot(EPOCH_ERROR_KM, left_km)), "the estimated clock offset takes up all but its change"
    growth = NUMERICAL_KM_PER_DAY * age if is_numerical else DRIFT_KM_PER_DAY * age + DRAG_KM_PER_DAY2 * age**2
    return float(np.hypot(EPOCH_ERROR_KM, growth)), f"orbit {age:.1f} d old"


def _other_km(orbit_model: str) -> tuple[float, float]:
    if orbit_model == "telemetry-position":
        return GNSS_KM, GNSS_KM
    return (EPHEMERIS_KM, EPHEMERIS_KM) if orbit_model == "oem" else (RADIAL_KM, CROSS_TRACK_KM)


# ---------------------------------------------------------------------------------------------------------- field


def _sources(samples: Samples, source: ReferenceSource) -> Iterator[BudgetItem]:
    """Yield what the field model leaves out."""
    radius_km = 6871.2
    if samples.r_itrf_km is not None:
        radii_km = lengths(samples.r_itrf_km)
        known = np.isfinite(radii_km)
        radius_km = float(np.median(radii_km if known.all() else radii_km[known], overwrite_input=True))
        omission = _omission(samples, source)
        if omission is not None:
            yield omission
        yield _prediction(samples, source)
    else:
        yield BudgetItem("field_model", None, "the reference came with the telemetry: its field model is not known")
    given = _given_degrees(source.field)
    crust_nt = crust_rms_nt(radius_km, given)
    height_km = radius_km - EARTH_RADIUS_MAGNETIC_KM
    degrees = (
        f"degrees above {MAX_DEGREE}" if given is None else f"degrees above {MAX_DEGREE} but {given[0]} to {given[1]}"
    )
    yield BudgetItem("crust", crust_nt, f"{degrees}, {CRUST_NT2_PER_DEGREE:g} nT^2 each, at {height_km:.0f} km")
    yield _external(samples, source)


def _external(samples: Samples, source: ReferenceSource) -> BudgetItem:
    """Return the considered errors of the external field along the orbit, and what no index tells of."""
    beside_nt = BESIDE_COMPONENT_NT if source.is_vector else BESIDE_MAGNITUDE_NT
    placed = None if samples.r_itrf_km is None else np.isfinite(samples.r_itrf_km).all(axis=1) & samples.is_used
    if samples.r_itrf_km is None or placed is None or not placed.any():
        size_nt = EXTERNAL_COMPONENT_NT if source.is_vector else EXTERNAL_MAGNITUDE_NT
        return BudgetItem("external", size_nt, "ring current and what it induces, where the place is not known")
    rows = np.flatnonzero(placed)
    few = rows[:: max(1, len(rows) // _PLACES)]
    t_utc, r_km = samples.t_utc[few], samples.r_itrf_km[few]
    errors = source.known.errors(nanoseconds(samples.t_utc[rows]), nanoseconds(t_utc), r_km)
    sizes = np.stack([one.error_nt for one in errors])
    if source.is_vector:
        squares = np.mean(sizes**2, axis=(1, 2))
    else:
        main_nt = source.field.field_itrf_nt(t_utc, r_km)
        main_nt /= np.linalg.norm(main_nt, axis=1, keepdims=True)
        squares = np.mean(np.einsum("mni,ni->mn", sizes, main_nt) ** 2, axis=1)
    words = ", ".join(f"{one.source.removeprefix('external_')} {one.why}" for one in errors)
    return BudgetItem("external", float(np.sqrt(squares.sum() + beside_nt**2)), f"{words}; {beside_nt:g} nT beside")


def _given_degrees(field: FieldModel) -> tuple[int, int] | None:
    """Return the first and the last degree above 13 that a file gives; None where none does."""
    file = field.crust or field.main if isinstance(field, SummedField) else field
    if not isinstance(file, FileField) or file.max_degree <= MAX_DEGREE:
        return None
    return max(file.min_degree, MAX_DEGREE + 1), file.max_degree


def crust_rms_nt(radius_km: float, given: tuple[int, int] | None = None) -> float:
    """Return the root mean square of a component, nT, of the crust's field above degree 13 at ``radius_km``.

    ``given``: first and last degree that the reference has.

    Notes
    -----
    <|B|^2> = sum over n > 13 of R_n (a/r)^(2n+4) with a flat surface spectrum R_n: a geometric series.
    """
    share = (EARTH_RADIUS_MAGNETIC_KM / radius_km) ** 2
    low, high = (MAX_DEGREE + 1, MAX_DEGREE) if given is None else given
    if share >= 1.0:
        return float(np.sqrt(CRUST_NT2_PER_DEGREE * max(0, 120 - (high - low + 1)) / 3.0))
    # share^(n+2) summed from each first degree on.
    powers = share ** (MAX_DEGREE + 3) - share ** (low + 2) + share ** (high + 3)
    return float(np.sqrt(CRUST_NT2_PER_DEGREE * max(0.0, powers) / (1.0 - share) / 3.0))


def _internal(field: FieldModel) -> FieldModel:
    """Return the main field of a model to degree 13, which is what there is to compare with."""
    main = field.main if isinstance(field, SummedField) else field
    if isinstance(main, FileField) and main.min_degree <= MAX_DEGREE < main.max_degree:
        return FileField(main.file, main.min_degree, MAX_DEGREE, main.name)
    return main


def _omission(samples: Samples, source: ReferenceSource) -> BudgetItem | None:
    """Return what the model that was used lacks beside the newest full one; None where it is that one."""
    from magcal_core.field.igrf import Igrf

    places = _places(samples)
    full, internal = Igrf(), _internal(source.field)
    if places is None or internal.name == full.name:
        return None
    t_utc, r_km, _ = places
    try:
        used, whole = internal.field_itrf_nt(t_utc, r_km), full.field_itrf_nt(t_utc, r_km)
    except ModelRangeError:
        return None
    size = _difference_nt(used, whole, is_vector=source.is_vector)
    return BudgetItem("field_model", size, f"{internal.name} against {full.name} along this orbit")


def _prediction(samples: Samples, source: ReferenceSource) -> BudgetItem:
    """Return how well the main field itself is known at the time of the data."""
    if isinstance(_internal(source.field), FileField):
        return BudgetItem("secular_variation", None, "the error of the file's main field is not known here")
    days = float((samples.t_utc[len(samples) // 2] - np.datetime64("2000-01-01")) / np.timedelta64(1, "D"))
    year = 2000.0 + days / 365.25
    if year <= 2020.0:
        return BudgetItem("secular_variation", 5.0, "definitive coefficients (until 2020)")
    if year <= 2025.0:
        return BudgetItem(
            "secular_variation", year - 2015.0, "between definitive 2020 and provisional 2025 coefficients"
        )
    size = 10.0 + PREDICTION_NT_PER_YEAR * (year - 2025.0)
    return BudgetItem("secular_variation", size, f"predicted from 2025: {PREDICTION_NT_PER_YEAR:g} nT a year")

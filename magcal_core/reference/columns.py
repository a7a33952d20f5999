"""Where the satellite was, and what the field was there: the reference columns of the samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask, Times
from magcal_core.attitude.rotation import rotate_rows
from magcal_core.errors import ModelRangeError, OrbitMissingError, TleEpochError
from magcal_core.field import FieldModel
from magcal_core.field.igrf import MAX_RADIUS_KM
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit import Orbit
from magcal_core.orbit.choose import (
    MAX_AGE_DAYS,
    NO_ORBIT,
    BoundedOrbit,
    Choice,
    InterpolatedOrbit,
    check_age,
    choose_orbits,
)
from magcal_core.orbit.earth.eop import earth_orientation, ut1_prediction_error_s
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.ephemeris.interpolation_check import BETTER_KM, REFUSED_KM
from magcal_core.reference.field_along_orbit import Part, field_of_parts, positions_km
from magcal_core.samples import SampleFlag, Samples
from magcal_core.telemetry.iso_times import Spans
from magcal_core.telemetry.time_guesses import on_distance, spans_of

TELEMETRY_REFERENCE: Final = "telemetry-reference"
TELEMETRY_POSITION: Final = "telemetry-position"
WEAK_SHARE: Final = 0.05
"""Field, as a share of the session's largest, below which a sample says more of the bias than of the sensor."""


@dataclass(frozen=True, slots=True)
class ReferenceReport:
    """Where the reference field came from.

    Attributes
    ----------
    orbit_model : str
        ``sgp4``, ``numerical``, ``oem`` (joined by ``+`` where several were used), ``telemetry-position`` or
        ``telemetry-reference``.
    orbits : tuple of mappings
        For each orbit used: its ``index`` in the sequence given, ``model``, ``epoch``, largest ``age_days``, and the
        number of ``samples`` that use it.
    field_model : str
        Name of the field model; of no effect where the telemetry has the field itself.
    warnings : tuple of str
        Codes and texts, such as ``tle_old: ...``.
    interpolation_km : float
        How far an ephemeris is off between its points at the most, km.
    """

    orbit_model: str
    orbits: tuple[Mapping[str, object], ...]
    field_model: str
    warnings: tuple[str, ...] = ()
    interpolation_km: float = 0.0


def with_reference(
    samples: Samples,
    orbits: Sequence[Orbit],
    field: FieldModel,
    *,
    time_offset_s: float = 0.0,
    max_orbit_age_days: float = MAX_AGE_DAYS,
) -> tuple[Samples, ReferenceReport]:
    """Return the samples with their reference field, and where it came from.

    A field in the telemetry is taken as it is; else the field is computed at the position in the telemetry, and for
    samples that lack one at the position that the orbit chosen for each gives. The magnitude is always filled; the
    field in GCRF and in the base frame where the samples have an attitude. Samples for which there is none are flagged
    ``NO_REFERENCE``.

    Parameters
    ----------
    samples, orbits, field
        Telemetry, the orbits to choose from, and the model of the field.
    time_offset_s : float
        Seconds to add to the telemetry's clock: the satellite is taken to have been where the orbit has it at ``t_utc``
        plus this.
    max_orbit_age_days : float
        Refuse an orbit whose epoch is farther from a sample, days.

    Raises
    ------
    OrbitMissingError
        Neither field nor position in the telemetry, and no orbit that covers it.
    TleEpochError
        An orbit is too old for a sample.
    ModelRangeError, PropagationError
        The field or the orbit cannot be had at a time or place.
    """
    if samples.has_reference:
        return _from_telemetry(samples), ReferenceReport(TELEMETRY_REFERENCE, (), field.name)
    t_true = samples.t_utc if not time_offset_s else samples.t_utc + np.timedelta64(round(time_offset_s * 1e9), "ns")
    if samples.r_itrf_km is not None:
        has_place = finite_rows(samples.r_itrf_km)
        if has_place.all() or not orbits:
            report = ReferenceReport(TELEMETRY_POSITION, (), field.name)
            parts = [Part.of(None, np.flatnonzero(has_place))]
            filled = _with_field(samples, t_true, samples.r_itrf_km, parts, field)
            return filled, replace(report, warnings=_far_warnings(filled))
    return _from_orbits(samples, t_true, orbits, field, max_age_days=max_orbit_age_days)


def _from_orbits(
    samples: Samples,
    t_true: Times,
    orbits: Sequence[Orbit],
    field: FieldModel,
    *,
    max_age_days: float,
) -> tuple[Samples, ReferenceReport]:
    """Return the samples with position and field, the positions that the telemetry lacks from the orbits."""
    r_itrf_km, parts, warnings, entries = _places(samples, t_true, orbits, max_age_days)
    models = {str(entry["model"]) for entry in entries}
    if any(part.orbit is None for part in parts):
        models.add(TELEMETRY_POSITION)
    has_place = finite_rows(r_itrf_km)
    if not has_place.any():
        raise OrbitMissingError(_not_covered(orbits, samples.t_utc))
    if gap := np.count_nonzero(~has_place):
        warnings.append(f"orbit_gap: no orbit covers {gap} of {len(samples)} samples")
    interpolation_km = _interpolation_km(t_true, parts)
    warnings += _predicted_earth(t_true)
    warnings += _off_between_points(interpolation_km) + _astray(t_true, parts)
    report = ReferenceReport(
        "+".join(sorted(models)), tuple(entries), field.name, tuple(warnings), float(interpolation_km)
    )
    cleared = samples.flags & ~np.where(has_place, np.uint16(SampleFlag.NO_REFERENCE), np.uint16(0))
    filled = _with_field(replace(samples, flags=cleared), t_true, r_itrf_km, parts, field)
    return filled, replace(report, warnings=(*report.warnings, *_far_warnings(filled)))


def _far_warnings(samples: Samples) -> tuple[str, ...]:
    """Return a warning of the samples that are too far out to be used; none where there are none."""
    count = int(np.count_nonzero(samples.flags & np.uint16(SampleFlag.FAR)))
    if not count:
        return ()
    return (
        f"far_samples_left_out: {count} of {len(samples)} samples are beyond {MAX_RADIUS_KM:.0f} km, or where the "
        f"field is less than a {1 / WEAK_SHARE:.0f}th of the session's largest",
    )


def _predicted_earth(t_utc: Times) -> list[str]:
    """Return the warning that the Earth's orientation at some of the times is a prediction, where it is one."""
    table = earth_orientation()
    days = table.predicted_days(t_utc)
    if days <= 0.0:
        return []
    last = np.datetime_as_string(table.predicted_from - np.timedelta64(1, "D"), unit="D")
    return [
        f"earth_orientation_predicted: UT1 and the pole are measured until {last} and predicted for up to {days:.0f} d "
        f"beyond it, UT1 to {1e3 * ut1_prediction_error_s(days):.1f} ms; a newer astropy-iers-data reaches further"
    ]


def _places(
    samples: Samples, t_true: Times, orbits: Sequence[Orbit], max_age_days: float
) -> tuple[Floats, list[Part], list[str], list[Mapping[str, object]]]:
    """Return the positions, shape (n, 3), km, NaN where no orbit covers; whence; warnings; an entry for each orbit."""
    entries: list[Mapping[str, object]] = []
    parts: list[Part] = []
    if samples.r_itrf_km is None:
        choice = choose_orbits(orbits, _deciding(t_true, orbits))
        warnings = _checked_age(choice, orbits, samples.t_utc, max_age_days)
        alone = int(choice.index[0]) if len(samples) else NO_ORBIT
        if alone != NO_ORBIT and np.all(choice.index == alone):
            entries.append(_entry(alone, orbits[alone], choice.age_days, len(samples)))
            del choice
            whole = Part(orbits[alone], slice(0, len(samples)))
            return positions_km(orbits[alone], t_true), [whole], warnings, entries
        r_itrf_km, rows = np.full((len(samples), 3), np.nan), np.arange(len(samples))
    else:
        r_itrf_km = samples.r_itrf_km.copy()
        is_known = finite_rows(r_itrf_km)
        if is_known.any():
            parts.append(Part.of(None, np.flatnonzero(is_known)))
        rows = np.flatnonzero(~is_known)
        choice = choose_orbits(orbits, t_true[rows])
        warnings = _checked_age(choice, orbits, samples.t_utc, max_age_days)
    for i, chosen in choice.by_orbit():
        part = Part.of(orbits[i], rows[chosen])
        r_itrf_km[part.rows] = positions_km(orbits[i], t_true[part.rows])
        parts.append(part)
        entries.append(_entry(i, orbits[i], choice.age_days[chosen], len(chosen)))
    return r_itrf_km, parts, warnings, entries


def _checked_age(choice: Choice, orbits: Sequence[Orbit], t_utc: Times, max_age_days: float) -> list[str]:
    """Return the warnings about old orbits; where one is refused, the form of time that would put the data near it."""
    try:
        return check_age(choice, orbits, max_age_days)
    except TleEpochError as error:
        raise TleEpochError(error.message + on_distance(t_utc[0], orbit_spans(orbits))) from error


def orbit_spans(orbits: Sequence[Orbit]) -> Spans:
    """Return where orbits are good: at their epochs, and where an ephemeris has positions."""
    return spans_of([(orbit.epoch_utc, getattr(orbit, "until_utc", None)) for orbit in orbits])


def _interpolation_km(t_true: Times, parts: Sequence[Part]) -> float:
    """Return how far the ephemerides are off between their points at the times of the samples at the most, km."""
    largest = 0.0
    for part in parts:
        orbit = part.orbit
        if isinstance(orbit, InterpolatedOrbit):
            largest = max(largest, float(orbit.interpolation_error_km(t_true[part.rows]).max(initial=0.0)))
    return largest


def _off_between_points(error_km: float) -> list[str]:
    """Return the warning of an ephemeris that is off between its points.

    Raises
    ------
    ModelRangeError
        It is off by more than an orbit may be.
    """
    if error_km > REFUSED_KM:
        raise ModelRangeError(
            f"the ephemeris is {error_km:.2g} km off between its points at the times of the telemetry; "
            f"limit {REFUSED_KM:g} km: send points closer together"
        )
    if error_km <= BETTER_KM:
        return []
    return [
        f"orbit_interpolation: the ephemeris is up to {error_km:.2g} km off between its points, and its velocities do "
        "not tell better; send points closer together"
    ]


def _astray(t_true: Times, parts: Sequence[Part]) -> list[str]:
    """Return the warning that ephemerides do not follow known forces at some of the times, where they do not."""
    count = 0
    for part in parts:
        if isinstance(part.orbit, InterpolatedOrbit):
            count += int(np.count_nonzero(part.orbit.is_astray(t_true[part.rows])))
    if not count:
        return []
    return [
        f"orbit_not_ballistic: about {count} of {len(t_true)} samples the points of the ephemeris do not go on into "
        "each other under gravity (a manoeuvre, or positions that scatter): how far it is off between them is "
        "estimated from points left out"
    ]


def _deciding(t_utc: Times, orbits: Sequence[Orbit]) -> Times:
    """Return the times that decide between the orbits and on their age: of one that reaches everywhere, the ends."""
    stamps_ns = nanoseconds(t_utc)
    if len(orbits) != 1 or isinstance(orbits[0], BoundedOrbit) or not len(t_utc):
        return t_utc
    return t_utc[[int(stamps_ns.argmin()), int(stamps_ns.argmax())]]


def _entry(index: int, orbit: Orbit, age_days: Floats, samples: int) -> Mapping[str, object]:
    return {
        "index": index,
        "model": orbit.model,
        "epoch": f"{np.datetime_as_string(orbit.epoch_utc, unit='us')}Z",
        "age_days": round(float(age_days.max()), 6),
        "samples": samples,
    }


def _not_covered(orbits: Sequence[Orbit], t_utc: Times) -> str:
    first, last = (np.datetime_as_string(t, unit="s") for t in (t_utc.min(), t_utc.max()))
    other_form = on_distance(t_utc.min(), orbit_spans(orbits))
    return f"none of the {len(orbits)} ephemerides covers the telemetry, {first}Z to {last}Z{other_form}"


def _with_field(samples: Samples, t_utc: Times, r_itrf_km: Floats, parts: Sequence[Part], field: FieldModel) -> Samples:
    """Return the samples with position and field; ``t_utc`` is the true time of each."""
    n, q = len(samples), samples.q_base_gcrf
    is_far = lengths(r_itrf_km) > MAX_RADIUS_KM
    if is_far.any() and not is_far.all():
        near = [(part.orbit, _rows_of(part, n)) for part in parts]
        parts = [Part.of(orbit, rows[~is_far[rows]]) for orbit, rows in near if not is_far[rows].all()]
    magnitude_nt = np.full(n, np.nan)
    b_gcrf_nt, b_base_nt = (None, None) if q is None else np.full((2, n, 3), np.nan)
    for rows, b_nt in field_of_parts(t_utc, parts, field, is_gcrf=q is not None, r_itrf_km=r_itrf_km):
        magnitude_nt[rows] = lengths(b_nt)
        if q is not None and b_gcrf_nt is not None and b_base_nt is not None:
            b_gcrf_nt[rows] = b_nt
            b_base_nt[rows] = rotate_rows(q[rows], b_nt)
    filled = replace(
        samples,
        r_itrf_km=r_itrf_km,
        b_ref_magnitude_nt=magnitude_nt,
        b_ref_gcrf_nt=b_gcrf_nt,
        b_ref_base_nt=b_base_nt,
    )
    is_far |= magnitude_nt < WEAK_SHARE * np.nanmax(magnitude_nt, initial=0.0)
    if is_far.any():
        filled = filled.flagged(SampleFlag.FAR, is_far)
    return filled.flagged(SampleFlag.NO_REFERENCE, np.isnan(magnitude_nt) & ~is_far)


def _rows_of(part: Part, n: int) -> NDArray[np.intp]:
    return np.arange(n)[part.rows]


def finite_rows(columns: Floats) -> Mask:
    """Return which rows of ``columns``, shape (n, m), are finite, shape (n,)."""
    is_finite = np.isfinite(columns)
    return np.ones(len(columns), np.bool_) if is_finite.all() else np.asarray(is_finite.all(axis=1))


def _from_telemetry(samples: Samples) -> Samples:
    """Return the samples with the forms of the reference that follow from those that were sent."""
    base_nt, gcrf_nt, magnitude_nt = samples.b_ref_base_nt, samples.b_ref_gcrf_nt, samples.b_ref_magnitude_nt
    if base_nt is None and gcrf_nt is not None and samples.q_base_gcrf is not None:
        base_nt = rotate_rows(samples.q_base_gcrf, gcrf_nt)
    if magnitude_nt is None:
        vector_nt = gcrf_nt if samples.b_ref_base_nt is None else samples.b_ref_base_nt
        magnitude_nt = None if vector_nt is None else lengths(vector_nt)
    filled = replace(samples, b_ref_base_nt=base_nt, b_ref_magnitude_nt=magnitude_nt)
    if magnitude_nt is None:
        return filled
    return filled.flagged(SampleFlag.NO_REFERENCE, ~np.isfinite(magnitude_nt))

"""What is known against the samples of a table, flag by flag, and the report of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask
from magcal_core.errors import TimeConflictError, TooManyBadSamplesError, UnitsError
from magcal_core.samples import SampleFlag, Samples
from magcal_core.telemetry.faults import FaultList
from magcal_core.units import COUNTS, NT_PER_UNIT

MAX_BAD_FRACTION: Final = 0.5
"""Share of samples without a usable reading or reference past which a table is refused."""
FEWEST_USED: Final = 10
"""Samples with a reading that must be left where some have none."""
MAX_CONFLICT_FRACTION: Final = 0.01
"""Share of samples that claim the time of another one with other values past which a table is refused."""
LARGEST_CELL: Final = 1e100
"""No cell of a reading is larger in any unit; squares stay finite below it."""
FILL_VALUES: Final = (-9999.0, -9999.9, -99999.0, -99999.9, -999999.0, 99999.0, 99999.9, 999999.0)
"""Numbers that loggers write for a missing reading."""
LEO_FIELD_NT: Final = (10_000.0, 70_000.0)
"""Bounds of |B| in low Earth orbit, nT."""
RATIO_TO_REFERENCE: Final = (0.1, 10.0)
"""Bounds of median |reading| / median |reference| in one unit."""
QUATERNION_TOLERANCE: Final = 1e-3
"""Distance of a quaternion's norm from 1 up to which it is normalised."""
EXACT_QUATERNION: Final = 1e-9
"""Distance of the norm from 1 up to which a quaternion is left as it was sent."""
MEDIAN_OF: Final = 10_000
"""Samples, evenly spaced, that a median is taken of."""
CELLS_AT_ONCE: Final = 1 << 14
"""Cells that are compared with all fill values while they are in the processor's cache."""
GAP_STEPS: Final = 1.5
"""A step longer than this many typical steps is a gap."""


@dataclass(frozen=True, slots=True)
class Quality:
    """What was found in one table.

    Attributes
    ----------
    rows : rows of the table.
    used : samples that no flag keeps out of a fit.
    flags : flag -> samples that bear it; a sample may bear several.
    rows_without_time : rows left out because their time cell is empty.
    rows_out_of_order : rows that stood before an earlier one.
    quaternions_normalised : quaternions whose norm was within 1e-3 of 1 and was set to 1.
    columns_ignored : columns that hold no numbers.
    span_s : time from the first to the last sample, s.
    step_s : median step, s; None with fewer than two samples.
    gaps : steps longer than one and a half median steps.
    longest_gap_s : the longest step, s.
    rows_unreadable : rows left out because they are none: a header among the rows, a last row that is cut.
    """

    rows: int
    used: int
    flags: Mapping[str, int]
    rows_without_time: int
    rows_out_of_order: int
    quaternions_normalised: int
    columns_ignored: tuple[str, ...]
    span_s: float
    step_s: float | None
    gaps: int
    longest_gap_s: float
    rows_unreadable: int = 0

    def to_dict(self) -> dict[str, object]:
        """Return the report as the records of the service have it."""
        report: dict[str, object] = {name: getattr(self, name) for name in self.__slots__}
        return report | {"flags": dict(self.flags), "columns_ignored": list(self.columns_ignored)}


def is_missing(values: Floats, fills: tuple[float, ...] = FILL_VALUES) -> Mask:
    """Return which cells hold no number: empty, not finite, past all measure, or one of ``fills``; shape (n,)."""
    missing = np.empty(len(values), bool)
    for at in range(0, len(values), CELLS_AT_ONCE):
        cells = values[at : at + CELLS_AT_ONCE]
        part = missing[at : at + CELLS_AT_ONCE]
        low, high = cells.min(), cells.max()
        if low >= -LARGEST_CELL and high <= LARGEST_CELL:
            part[:] = False
        else:
            np.logical_not(np.abs(cells) <= LARGEST_CELL, out=part)
            low, high = -LARGEST_CELL, LARGEST_CELL
        for fill in fills:
            if low <= fill <= high:
                part |= cells == fill
    return missing


def normalised(q: Floats) -> tuple[Floats, Mask, int]:
    """Return unit quaternions, which ones are none (NaN then), and how many were normalised; shape (n, 4)."""
    size = np.abs(q).max(axis=1, initial=0.0)
    is_usable = np.isfinite(size) & (size < 2.0)
    safe = np.where(is_usable[:, None], q, 0.0)
    norm = np.sqrt(np.einsum("ij,ij->i", safe, safe))
    is_unit = np.abs(norm - 1.0) <= QUATERNION_TOLERANCE
    is_rounded = is_unit & (np.abs(norm - 1.0) > EXACT_QUATERNION)
    unit = np.where(is_unit[:, None], q, np.nan)
    unit[is_rounded] /= norm[is_rounded, None]
    return unit, ~is_unit, int(np.count_nonzero(is_rounded))


def flag_repeated_times(samples: Samples) -> Samples:
    """Return ``samples``, which are in time order, with repeated times flagged.

    Of samples with one time and equal values the first is kept and the others are ``DUPLICATE_TIME``; where the
    values differ all are ``CONFLICTING_TIME``. Samples without a reading take no part.
    """
    if not (samples.t_utc[1:] == samples.t_utc[:-1]).any():
        return samples
    known = np.flatnonzero((samples.flags & np.uint16(SampleFlag.NOT_FINITE)) == 0)
    t = samples.t_utc[known]
    is_repeat = np.zeros(len(t), bool)
    is_repeat[1:] = t[1:] == t[:-1]
    if not is_repeat.any():
        return samples
    values = _measured(samples)[known]
    group = np.cumsum(~is_repeat) - 1
    first = np.flatnonzero(~is_repeat)[group]
    differs = ~np.all((values == values[first]) | (np.isnan(values) & np.isnan(values[first])), axis=1)
    in_conflict = np.bincount(group, weights=differs)[group] > 0
    conflicting, duplicate = np.zeros(len(samples), bool), np.zeros(len(samples), bool)
    conflicting[known] = in_conflict
    duplicate[known] = is_repeat & ~in_conflict
    return samples.flagged(SampleFlag.DUPLICATE_TIME, duplicate).flagged(SampleFlag.CONFLICTING_TIME, conflicting)


def _measured(samples: Samples) -> Floats:
    """Return everything measured of each sample side by side, shape (n, m)."""
    columns = (
        samples.h_nt,
        samples.q_base_gcrf,
        samples.b_ref_base_nt,
        samples.b_ref_gcrf_nt,
        samples.b_ref_magnitude_nt,
        samples.r_itrf_km,
    )
    return np.column_stack([column for column in columns if column is not None])


def check_bad_share(samples: Samples, rows_without_time: int, limit: float) -> None:
    """Refuse a table with too many samples that have no reading, no time or no reference.

    Raises
    ------
    TooManyBadSamplesError
        Their share is above ``limit``.
    """
    flag = np.uint16(SampleFlag.NOT_FINITE | SampleFlag.NO_REFERENCE | SampleFlag.FILL_VALUE)
    bad = int(np.count_nonzero(samples.flags & flag)) + rows_without_time
    rows = len(samples) + rows_without_time
    if bad > limit * rows:
        raise TooManyBadSamplesError(
            f"{bad} of {rows} samples ({100 * bad / rows:.1f} %) have an empty, non-finite or fill value "
            f"where a number is needed; the limit is {100 * limit:g} %"
        )
    if bad and rows - bad < FEWEST_USED and limit < 1.0:
        raise TooManyBadSamplesError(
            f"{bad} of {rows} samples have an empty, non-finite or fill value where a number is needed; "
            f"{rows - bad} are left, at least {FEWEST_USED} are needed"
        )


def check_conflicts(samples: Samples, limit: float) -> None:
    """Refuse a table in which too many samples claim one time with different values.

    Raises
    ------
    TimeConflictError
        Their share is above ``limit``; the faults name the times.
    """
    is_conflict = (samples.flags & np.uint16(SampleFlag.CONFLICTING_TIME)) != 0
    count = int(np.count_nonzero(is_conflict))
    if count > limit * len(samples):
        faults = FaultList("table")
        for t in np.unique(samples.t_utc[is_conflict]):
            faults.add(TimeConflictError, f"time {np.datetime_as_string(t, unit='us')}Z", "several different readings")
        raise TimeConflictError(
            f"{count} of {len(samples)} samples share their time with a different one; the limit is {100 * limit:g} %",
            faults.first,
        )


def check_units(
    samples: Samples, unit: str, field_range_nt: tuple[float, float], nt_per_count: float | None = None
) -> None:
    """Refuse readings that belie their unit where another known unit explains them.

    With a reference in the table, median |reading| must be within `RATIO_TO_REFERENCE` of median |reference|;
    without one, median |reading| must be within ``field_range_nt``.

    Raises
    ------
    UnitsError
        The message names the unit that fits and the factor; nothing is converted.
    """
    used = _some_used(samples)
    if len(used) == 0:
        return
    reading_nt = _median_norm(used.h_nt)
    reference_nt = _median_reference(used)
    if reference_nt is None:
        low, high, target = *field_range_nt, float(np.sqrt(field_range_nt[0] * field_range_nt[1]))
        expected = f"{low / 1e3:g}-{high / 1e3:g} uT"
    else:
        low, high, target = (*(reference_nt * bound for bound in RATIO_TO_REFERENCE), reference_nt)
        expected = f"{low:.3g}-{high:.3g} nT, as the reference in the table has it"
    if low <= reading_nt <= high or reading_nt == 0.0:
        return
    if unit == COUNTS:
        _refuse_count(reading_nt, nt_per_count or 1.0, (low, high, target), expected)
        return
    factors = {other: NT_PER_UNIT[other] / NT_PER_UNIT[unit] for other in NT_PER_UNIT if other != unit}
    fitting = {other: f for other, f in factors.items() if low <= reading_nt * f <= high}
    if not fitting:
        return
    best = min(fitting, key=lambda other: abs(np.log(reading_nt * fitting[other] / target)))
    raise UnitsError(
        f"median |B| of the readings is {reading_nt:.6g} nT if they are in {unit}, expected {expected}; "
        f"they look like {best}: {fitting[best]:g} times as much",
        looks_like=best,
    )


def _refuse_count(reading_nt: float, nt_per_count: float, bounds: tuple[float, float, float], expected: str) -> None:
    """Refuse a size of the count that puts the readings more than ten times outside what is expected."""
    low, high, target = bounds
    if not low / 10.0 <= reading_nt <= high * 10.0:
        raise UnitsError(
            f"median |B| of the readings is {reading_nt:.6g} nT with {nt_per_count:g} nT per count, want {expected};"
            f" about {nt_per_count * target / reading_nt:.2g} nT per count would fit"
        )


def _some_used(samples: Samples) -> Samples:
    """Return some of the samples that no flag keeps out of a fit, evenly spaced, enough for a median."""
    if not samples.flags.any():
        return samples.take(slice(None, None, max(len(samples) // MEDIAN_OF, 1)))
    rows = np.flatnonzero(samples.is_used)
    return samples.take(rows[:: max(len(rows) // MEDIAN_OF, 1)])


def _median_norm(vectors: Floats) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))


def _median_reference(samples: Samples) -> float | None:
    if samples.b_ref_magnitude_nt is not None:
        return float(np.median(np.abs(samples.b_ref_magnitude_nt)))
    vectors = samples.b_ref_base_nt if samples.b_ref_base_nt is not None else samples.b_ref_gcrf_nt
    return None if vectors is None else _median_norm(vectors)


def report(
    samples: Samples,
    *,
    rows_without_time: int = 0,
    rows_out_of_order: int = 0,
    quaternions_normalised: int = 0,
    columns_ignored: tuple[str, ...] = (),
    rows_unreadable: int = 0,
) -> Quality:
    """Return the quality report of ``samples``, which are in time order."""
    t_ns = samples.t_utc.astype("datetime64[ns]", copy=False).view(np.int64)
    steps_ns = t_ns[1:] - t_ns[:-1]
    if steps_ns.size and steps_ns.min() == 0:
        steps_ns = steps_ns[steps_ns > 0]
    step_ns = _median_step(steps_ns) if steps_ns.size else None
    return Quality(
        rows=len(samples) + rows_without_time + rows_unreadable,
        used=int(np.count_nonzero(samples.is_used)),
        flags=count_flags(samples),
        rows_without_time=rows_without_time,
        rows_out_of_order=rows_out_of_order,
        quaternions_normalised=quaternions_normalised,
        columns_ignored=columns_ignored,
        span_s=float(t_ns[-1] - t_ns[0]) / 1e9 if len(t_ns) else 0.0,
        step_s=None if step_ns is None else step_ns / 1e9,
        gaps=0 if step_ns is None else int(np.count_nonzero(steps_ns > GAP_STEPS * step_ns)),
        longest_gap_s=float(steps_ns.max(initial=0)) / 1e9,
        rows_unreadable=rows_unreadable,
    )


def _median_step(steps_ns: NDArray[np.int64]) -> float:
    """Return the median step; the step of more than half of a regular table is known to be it without a sort."""
    usual = steps_ns[len(steps_ns) // 2]
    if 2 * int(np.count_nonzero(steps_ns == usual)) > len(steps_ns):
        return float(usual)
    return float(np.median(steps_ns))


def count_flags(samples: Samples) -> dict[str, int]:
    """Return flag -> samples that bear it, for the flags that occur."""
    present = int(np.bitwise_or.reduce(samples.flags, initial=np.uint16(0)))
    flags = [flag for flag in SampleFlag if flag & present]
    return {flag.name.lower(): int(np.count_nonzero(samples.flags & np.uint16(flag))) for flag in flags if flag.name}

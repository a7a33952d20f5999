"""From the columns of a table to Samples: time order, nT, unit quaternions, flags."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.errors import TelemetryFormatError
from magcal_core.samples import SampleFlag, Samples
from magcal_core.telemetry import quality, screen
from magcal_core.telemetry.columns import (
    ATTITUDE,
    POSITION,
    READING,
    REFERENCE_BASE,
    REFERENCE_GCRF,
    REFERENCE_MAGNITUDE,
    STANDARD,
)
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import NO_TIME
from magcal_core.telemetry.quality import Quality
from magcal_core.telemetry.table import RawTable
from magcal_core.telemetry.times import check_plausible, to_utc_ns
from magcal_core.units import nt_per


@dataclass(frozen=True, slots=True)
class Judgement:
    """How a table is judged.

    Attributes
    ----------
    unit : unit of the readings.
    range_nt : the magnetometer's range, nT; readings at or beyond it are saturated. None where it is not known.
    time_scale : of `TIME_SCALES`.
    field_range_nt : bounds of |B|, nT, that tell a wrong unit; None leaves the unit unchecked.
    max_bad_fraction : share of samples without a reading or reference past which the table is refused.
    max_conflict_fraction : share of samples in conflict past which the table is refused.
    nt_per_count : nT in one count, where the unit is ``counts``.
    fill_values : numbers that this magnetometer sends for a missing reading, in its own unit.
    """

    unit: str = "nT"
    range_nt: float | None = None
    time_scale: str = "utc"
    field_range_nt: tuple[float, float] | None = quality.LEO_FIELD_NT
    max_bad_fraction: float = quality.MAX_BAD_FRACTION
    max_conflict_fraction: float = quality.MAX_CONFLICT_FRACTION
    nt_per_count: float | None = None
    fill_values: tuple[float, ...] = ()


AS_SENT: Final = Judgement()


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """Samples of one table and what was found in it."""

    samples: Samples
    quality: Quality


def assemble(table: RawTable, judgement: Judgement = AS_SENT) -> Telemetry:
    """Return the samples of a table in time order, flagged and in nT, with the quality report.

    A cell without a reading is NaN in the samples; rows without a time are left out and counted.

    Raises
    ------
    InputError
        A time is implausible, the unit is unknown or belied, or too many samples are flagged.
    """
    factor = nt_per(judgement.unit, judgement.nt_per_count)
    t_ns, order, rows_out_of_order = _time_order(table, judgement.time_scale)
    without_time = len(table.t_ns) - len(t_ns)
    reading, is_complete = _stacked(table, READING, order, fills=())
    is_complete = is_complete and not _leave_out(reading, table.is_valid, order, judgement.fill_values)
    flags = _flags(reading, is_complete, factor, judgement.range_nt)
    flags |= screen.fill_flags(reading, (flags & np.uint16(SampleFlag.NOT_FINITE)) == 0)
    reference = {
        group: _optional(table, group, order) for group in (REFERENCE_BASE, REFERENCE_GCRF, REFERENCE_MAGNITUDE)
    }
    position = _optional(table, POSITION, order)
    flags |= _flag_missing_reference([column for column in reference.values() if column is not None], position)
    attitude, normalised = _attitude(table, order, flags)
    magnitude = reference[REFERENCE_MAGNITUDE]
    samples = Samples(
        t_utc=t_ns.view("datetime64[ns]"),
        h_nt=reading if factor == 1.0 else reading * factor,
        q_base_gcrf=attitude,
        b_ref_base_nt=reference[REFERENCE_BASE],
        b_ref_gcrf_nt=reference[REFERENCE_GCRF],
        b_ref_magnitude_nt=None if magnitude is None else magnitude[:, 0],
        r_itrf_km=position,
        housekeeping=_housekeeping(table, order, flags),
        flags=flags,
    )
    samples = quality.flag_repeated_times(samples)
    quality.check_bad_share(samples, without_time + table.bad_rows, judgement.max_bad_fraction)
    quality.check_conflicts(samples, judgement.max_conflict_fraction)
    if judgement.field_range_nt is not None:
        quality.check_units(samples, judgement.unit, judgement.field_range_nt, judgement.nt_per_count)
    found = quality.report(
        samples,
        rows_without_time=without_time,
        rows_out_of_order=rows_out_of_order,
        quaternions_normalised=normalised,
        columns_ignored=table.ignored,
        rows_unreadable=table.bad_rows,
    )
    return Telemetry(samples, found)


def _time_order(table: RawTable, time_scale: str) -> tuple[NDArray[np.int64], NDArray[np.intp] | None, int]:
    """Return the times in order, the order (None where the rows stand in it), and the rows that were out of it."""
    t_ns = to_utc_ns(table.t_ns, time_scale=table.scale or time_scale, is_epoch=table.is_epoch)
    faults = FaultList("table")
    check_plausible(t_ns, faults)
    faults.raise_if_any()
    is_whole = t_ns.size > 0 and t_ns.min() != NO_TIME
    rows = None if is_whole else np.flatnonzero(t_ns != NO_TIME)
    if rows is not None:
        if rows.size == 0:
            raise TelemetryFormatError("the table has no row with a time")
        t_ns = t_ns[rows]
    backwards = int(np.count_nonzero(t_ns[1:] < t_ns[:-1]))
    if not backwards:
        return t_ns, rows, 0
    order = np.argsort(t_ns, kind="stable")
    return t_ns[order], order if rows is None else rows[order], backwards


def _stacked(
    table: RawTable,
    names: tuple[str, ...],
    order: NDArray[np.intp] | None,
    fills: tuple[float, ...] = quality.FILL_VALUES,
) -> tuple[Floats, bool]:
    """Return columns side by side in time order, and whether every cell has a value; one without is NaN."""
    columns = [table.numbers[name] if order is None else table.numbers[name][order] for name in names]
    stacked, is_complete = np.empty((len(columns[0]), len(names))), True
    # Some rows of all columns at a time: what is written side by side then stays in the processor's cache.
    for at in range(0, len(stacked), quality.CELLS_AT_ONCE):
        rows = slice(at, at + quality.CELLS_AT_ONCE)
        for i, column in enumerate(columns):
            missing = quality.is_missing(column[rows], fills)
            is_gap = bool(missing.any())
            stacked[rows, i] = np.where(missing, np.nan, column[rows]) if is_gap else column[rows]
            is_complete = is_complete and not is_gap
    return stacked, is_complete


def _leave_out(
    reading: Floats, is_valid: NDArray[np.bool_] | None, order: NDArray[np.intp] | None, fill_values: tuple[float, ...]
) -> bool:
    """Empty the readings that the table says are not valid or that have a fill value; return whether any are."""
    left_out = np.zeros(len(reading), bool)
    if is_valid is not None:
        left_out |= ~(is_valid if order is None else is_valid[order])
    for fill in fill_values:
        left_out |= (reading == fill).any(axis=1)
    reading[left_out] = np.nan
    return bool(left_out.any())


def _optional(table: RawTable, names: tuple[str, ...], order: NDArray[np.intp] | None) -> Floats | None:
    return _stacked(table, names, order)[0] if names[0] in table.numbers else None


def _flags(reading: Floats, is_complete: bool, factor: float, range_nt: float | None) -> NDArray[np.uint16]:
    flags = np.zeros(len(reading), np.uint16)
    if not is_complete:
        flags[np.isnan(reading).any(axis=1)] = SampleFlag.NOT_FINITE
    if range_nt is not None:
        # A reading at the rail may miss the range by rounding.
        rail = range_nt / factor * (1.0 - 1e-9)
        flags |= np.where((np.abs(reading) >= rail).any(axis=1), np.uint16(SampleFlag.SATURATED), np.uint16(0))
    return flags


def _flag_missing_reference(references: list[Floats], position: Floats | None) -> NDArray[np.uint16] | np.uint16:
    needed = references or ([] if position is None else [position])
    if not needed:
        return np.uint16(0)
    missing = np.isnan(np.column_stack(needed).sum(axis=1))
    return np.where(missing, np.uint16(SampleFlag.NO_REFERENCE), np.uint16(0))


def _attitude(table: RawTable, order: NDArray[np.intp] | None, flags: NDArray[np.uint16]) -> tuple[Floats | None, int]:
    """Return unit quaternions and how many were normalised; flag the samples without one."""
    sent = _optional(table, ATTITUDE, order)
    if sent is None:
        return None, 0
    q, is_none, normalised = quality.normalised(sent)
    flags[is_none] |= np.uint16(SampleFlag.NO_ATTITUDE)
    return q, normalised


def _housekeeping(table: RawTable, order: NDArray[np.intp] | None, flags: NDArray[np.uint16]) -> dict[str, Floats]:
    keeping: dict[str, Floats] = {}
    for name, column in table.numbers.items():
        if name in STANDARD:
            continue
        values = np.require(column, requirements="W") if order is None else column[order]
        is_missing = ~np.isfinite(values)
        if is_missing.any():
            flags[is_missing] |= np.uint16(SampleFlag.NO_HOUSEKEEPING)
            values = np.where(is_missing, np.nan, values)
        keeping[name] = values
    return keeping


def merge_samples(parts: list[Samples]) -> Samples:
    """Return the samples of several tables as one, in time order, repeated times flagged again.

    Columns that only some parts have are NaN in the others; a sample without attitude or reference among samples
    that have one is flagged for it.

    Raises
    ------
    TelemetryFormatError
        There is no part.
    """
    if not parts:
        raise TelemetryFormatError("there is no telemetry")
    if len(parts) == 1:
        return parts[0]
    repeats = np.uint16(SampleFlag.DUPLICATE_TIME | SampleFlag.CONFLICTING_TIME)
    flags = np.concatenate([part.flags & ~repeats for part in parts])
    names = list(dict.fromkeys(name for part in parts for name in part.housekeeping))
    merged = Samples(
        t_utc=np.concatenate([part.t_utc for part in parts]),
        h_nt=np.concatenate([part.h_nt for part in parts]),
        q_base_gcrf=_joined(parts, [part.q_base_gcrf for part in parts], flags, SampleFlag.NO_ATTITUDE),
        b_ref_base_nt=_joined(parts, [part.b_ref_base_nt for part in parts], flags, SampleFlag.NO_REFERENCE),
        b_ref_gcrf_nt=_joined(parts, [part.b_ref_gcrf_nt for part in parts], flags, SampleFlag.NO_REFERENCE),
        b_ref_magnitude_nt=_joined(parts, [p.b_ref_magnitude_nt for p in parts], flags, SampleFlag.NO_REFERENCE),
        r_itrf_km=_joined(parts, [part.r_itrf_km for part in parts], flags, SampleFlag.NO_REFERENCE),
        housekeeping={
            name: column
            for name in names
            if (column := _joined(parts, [p.housekeeping.get(name) for p in parts], flags, SampleFlag.NO_HOUSEKEEPING))
            is not None
        },
        flags=flags,
    )
    in_order = merged.take(np.argsort(merged.t_utc, kind="stable"))
    return quality.flag_repeated_times(in_order)


def _joined(
    parts: list[Samples], columns: list[Floats | None], flags: NDArray[np.uint16], flag: SampleFlag
) -> Floats | None:
    """Return one column of all parts; flag the samples of parts that lack it."""
    shape = next((column.shape[1:] for column in columns if column is not None), None)
    if shape is None:
        return None
    lacks = [np.full(len(part), column is None) for part, column in zip(parts, columns, strict=True)]
    flags[np.concatenate(lacks)] |= np.uint16(flag)
    filled = [
        np.full((len(part), *shape), np.nan) if column is None else column
        for part, column in zip(parts, columns, strict=True)
    ]
    return np.concatenate(filled)

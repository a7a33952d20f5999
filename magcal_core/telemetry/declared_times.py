"""Times of a declared form, from columns of text or numbers to nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from datetime import UTC as UTC_ZONE
from datetime import datetime, timedelta
from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import InputError, TelemetryFormatError, TimeError
from magcal_core.telemetry.arrow_numbers import floats_of, integers_of, is_text
from magcal_core.telemetry.day_of_year import day_of_year_ns, year_and_day_ns
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import NO_TIME, Spans, parse_iso_ns
from magcal_core.telemetry.time_forms import DATE_TIME, DAY_OF_YEAR, GPS_WEEK, UTC, WORDS, Count, TimeColumns
from magcal_core.telemetry.time_guesses import on_text

Where = Callable[[int], str]
"""Number of a row, from 0 -> its place as a fault names it."""

_NS: Final = 1_000_000_000
_DAY: Final = 86_400 * _NS
_LARGEST_NS: Final = 9_200_000_000_000_000_000
_LARGEST_COUNT: Final = 9_000_000_000_000_000_000
_DECIMAL: Final = r"^\s*(?P<sign>[+-]?)0*(?P<whole>\d{1,18}|[1-8]\d{18})(?:[.,](?P<fraction>\d*))?\s*$"


def declared_times(
    times: TimeColumns, columns: Mapping[str, pa.ChunkedArray], where: Where, faults: FaultList
) -> tuple[Nanoseconds, str]:
    """Return the nanoseconds of times of a declared form, and their scale, ``utc`` or ``gps``.

    ``columns`` has the parts of ``times.own``, as text or as numbers; empty cells give `NO_TIME`, and cells that are
    not of the form are noted as faults.
    """
    form, count = times.form, times.form.count
    if count is not None:
        return _counted(columns["time"], count, where, faults), count.scale
    if form.name == GPS_WEEK:
        return _gps_weeks(columns, where, faults), "gps"
    cells = _joined(times, columns)
    year = _year_of(form.epoch_ns)
    readers: dict[str, Callable[[str], int]] = {UTC: _zoneless, DATE_TIME: _zoneless}
    if form.is_pattern:
        read: Callable[[str], int] = _by_pattern(form.name)
    elif form.name == DAY_OF_YEAR:
        read = year_and_day_ns if "year" in times.own else lambda text: day_of_year_ns(text, year)
    else:
        read = readers[form.name]
    t_ns = _each(cells, read, form.name, where, faults)
    if faults.count and form.name in readers:
        faults.advise(_advice(cells, t_ns, form.spans))
    return t_ns, "utc"


def _advice(cells: list[str | None], t_ns: Nanoseconds, spans: Spans) -> str:
    """Return which pattern the first time that could not be read has, "" where none that is known."""
    faulty = (text for text, stamp in zip(cells, t_ns, strict=True) if text is not None and stamp == NO_TIME)
    return on_text(next(faulty, ""), spans)


def _each(
    cells: list[str | None], read: Callable[[str], int], name: str, where: Where, faults: FaultList
) -> Nanoseconds:
    t_ns = np.full(len(cells), NO_TIME, np.int64)
    for i, text in enumerate(cells):
        if text is None:
            continue
        try:
            t_ns[i] = read(text)
        except InputError as error:
            faults.add(type(error), where(i), error.message, text)
        except (ValueError, OverflowError):
            faults.add(TimeError, where(i), f"not a time of the form declared ({WORDS.get(name, name)})", text)
    return t_ns


def _joined(times: TimeColumns, columns: Mapping[str, pa.ChunkedArray]) -> list[str | None]:
    """Return the text of each time, parts with a blank between them; None where one is empty."""
    parts = [_texts(columns[part], _WIDTH.get((times.form.name, part), 0)) for part in times.own]
    rows = zip(*parts, strict=True)
    return [None if any(not part for part in row) else " ".join(str(part) for part in row) for row in rows]


_WIDTH: Final = {(DATE_TIME, "time"): 6, (DATE_TIME, "date"): 8}
"""Digits that a number has lost its zeros of: 3744 is 003744."""


def _texts(column: pa.ChunkedArray, width: int) -> list[str | None]:
    cells = column.to_pylist()
    texts: list[str | None] = []
    for cell in cells:
        if cell is None or (isinstance(cell, float) and not np.isfinite(cell)):
            texts.append(None)
        elif isinstance(cell, float) and cell.is_integer():
            texts.append(str(int(cell)).zfill(width))
        else:
            texts.append(str(cell).strip().zfill(width) if isinstance(cell, int) else str(cell).strip())
    return texts


def _zoneless(text: str) -> int:
    """Return an ISO 8601 time, or a date and a time; one without a zone is UTC."""
    plain = re.sub(r"(?<=\d) +(?=\d)", "T", text.strip(), count=1)
    return parse_iso_ns(plain, is_utc=True)


def _by_pattern(pattern: str) -> Callable[[str], int]:
    def read(text: str) -> int:
        moment = datetime.strptime(text, pattern)  # noqa: DTZ007 - a time without a zone is UTC by declaration
        aware = moment if moment.tzinfo else moment.replace(tzinfo=UTC_ZONE)
        return (aware - datetime(1970, 1, 1, tzinfo=UTC_ZONE)) // timedelta(microseconds=1) * 1000

    return read


def _year_of(epoch_ns: int | None) -> int | None:
    return None if epoch_ns is None else int(str(np.datetime64(epoch_ns, "ns"))[:4])


def _counted(column: pa.ChunkedArray, count: Count, where: Where, faults: FaultList) -> Nanoseconds:
    """Return numbers of ``count`` in nanoseconds: text exactly, doubles to the microsecond."""
    whole, part, is_given = _numbers(column, f"not a number ({count.words})", where, faults)
    # The epoch in whole units and a rest: Julian days begin further back than 64 bits of nanoseconds reach.
    zero, rest_ns = divmod(count.zero_ns, count.unit_ns)
    largest = _LARGEST_NS // count.unit_ns
    since_1970 = np.clip(np.clip(whole, -_LARGEST_COUNT, _LARGEST_COUNT) + zero, -largest, largest)
    grain = 1 if is_text(column.type) else 1000
    fraction_ns = np.rint(part * (count.unit_ns / grain)).astype(np.int64) * grain
    t_ns = since_1970 * count.unit_ns + rest_ns + fraction_ns
    return np.where(is_given, t_ns, NO_TIME)


def _gps_weeks(columns: Mapping[str, pa.ChunkedArray], where: Where, faults: FaultList) -> Nanoseconds:
    week, _, has_week = _numbers(columns["gps_week"], "not a GPS week", where, faults)
    second, part, has_second = _numbers(columns["gps_seconds"], "not seconds of the week", where, faults)
    is_given = has_week & has_second
    is_odd = is_given & ((week < 0) | (week > 10_000) | (second < 0) | (second > 604_800))
    for i in np.flatnonzero(is_odd):
        faults.add(TimeError, where(int(i)), "want a week of 0 to 10000 and seconds of 0 to 604800", int(second[i]))
    zero_ns = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
    t_ns = zero_ns + np.clip(week, 0, 10_000) * 7 * _DAY + np.clip(second, 0, 604_800) * _NS
    return np.where(is_given, t_ns + np.rint(part * 1e6).astype(np.int64) * 1000, NO_TIME)


def _numbers(
    column: pa.ChunkedArray, why: str, where: Where, faults: FaultList
) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
    """Return the whole part, the rest from 0 to 1, and which cells have a number, shape (n,) each."""
    if pa.types.is_integer(column.type):
        whole = integers_of(column, NO_TIME)
        return whole, np.zeros(len(whole)), whole != NO_TIME
    if pa.types.is_floating(column.type):
        values = floats_of(column)
        is_given = np.isfinite(values)
        limited = np.clip(np.where(is_given, values, 0.0), -9.2e18, 9.2e18)
        floor = np.floor(limited)
        return floor.astype(np.int64), limited - floor, is_given
    if pa.types.is_null(column.type):
        return np.zeros(len(column), np.int64), np.zeros(len(column)), np.zeros(len(column), bool)
    if not is_text(column.type):
        raise TelemetryFormatError(f"a column of times holds {column.type}, want {why.removeprefix('not ')}")
    return _decimals(column, why, where, faults)


def _decimals(
    column: pa.ChunkedArray, why: str, where: Where, faults: FaultList
) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
    """Return numbers in text, split at their point so that nothing of them is lost."""
    import pyarrow.compute as pc

    found = pc.extract_regex(column, _DECIMAL)
    whole = integers_of(pc.struct_field(found, "whole").cast(pa.int64()), NO_TIME)
    part = np.zeros(len(whole))
    digits = pc.struct_field(found, "fraction")
    has_part = pc.fill_null(pc.greater(pc.utf8_length(digits), 0), False)
    if pc.any(has_part).as_py():
        text = pc.binary_join_element_wise("0.", pc.fill_null(digits, "0"), "0", "")
        part = floats_of(text.cast(pa.float64()))
    is_minus = np.array(pc.fill_null(pc.equal(pc.struct_field(found, "sign"), "-"), False).to_pylist(), bool)
    is_given = whole != NO_TIME
    whole = np.where(is_given, np.where(is_minus, -whole, whole), 0)
    part = np.where(is_minus, -part, part)
    others = {} if is_given.all() else _others(column, np.flatnonzero(~is_given), why, where, faults)
    for i, value in others.items():
        whole[i], part[i], is_given[i] = int(value // 1), value % 1, True
    return whole, part, is_given


def _others(
    column: pa.ChunkedArray, rows: NDArray[np.intp], why: str, where: Where, faults: FaultList
) -> dict[int, float]:
    """Return the numbers that are no plain decimals, such as powers of ten; empty cells stay, the rest is faulty."""
    found: dict[int, float] = {}
    for i in rows.tolist():
        text = column[i].as_py()
        if text is None or not text.strip():
            continue
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if abs(value) < _LARGEST_COUNT:
            found[i] = value
        else:
            faults.add(TimeError, where(i), why, text)
    return found

"""What both JSON formats share: strict parsing, and cells turned into times and numbers with every fault noted."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import TelemetryFormatError, TelemetryValueError, TimeError
from magcal_core.telemetry.arrow_numbers import floats_of
from magcal_core.telemetry.columns import ColumnPlan
from magcal_core.telemetry.declared_times import declared_times
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import Spans
from magcal_core.telemetry.table import RawTable
from magcal_core.telemetry.times import epoch_ns, parse_times

Cells = Sequence[object]

NOT_FINITE_TOKENS: Final = (b"NaN", b"Infinity")
"""Tokens that JSON does not have and that many writers send."""


class _NotJson(str):
    """A token such as NaN, kept so that its place can be named."""

    __slots__ = ()


def parse_json(text: bytes, *, where: str) -> object:
    """Return the value of a JSON text without doubled keys; NaN and infinities are kept as tokens.

    Raises
    ------
    TelemetryFormatError
        The text is not JSON, doubles a key, nests past all measure or has a number of thousands of digits.
    """
    try:
        return json.loads(text, object_pairs_hook=_without_doubles, parse_constant=_NotJson)
    except RecursionError as error:
        raise TelemetryFormatError(f"{where}: nested deeper than any table") from error
    except json.JSONDecodeError as error:
        raise TelemetryFormatError(f"{where}: not JSON at character {error.pos + 1}: {error.msg}") from error
    except ValueError as error:
        raise TelemetryFormatError(f"{where}: {error}") from error


def _without_doubles(pairs: list[tuple[str, object]]) -> dict[str, object]:
    together = dict(pairs)
    if len(together) < len(pairs):
        keys = [key for key, _ in pairs]
        doubled = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"key {doubled[:60]!r} stands more than once")
    return together


def has_infinite(table: pa.Table) -> bool:
    """Return whether a number in an Arrow table was too large for a double; JSON has no infinities of its own."""
    doubles = [column for column in table.columns if column.type == pa.float64()]
    return any(bool(np.isinf(floats_of(column)).any()) for column in doubles)


def to_raw_table(columns: Mapping[str, Cells], plan: ColumnPlan, *, row_word: str, table: str) -> RawTable:
    """Return cells as JSON has them as a raw table; raise with every fault among them.

    ``columns`` has the cells under the table's own names, None for an empty one; ``row_word`` is what the format
    calls its rows, which are counted from 1.

    Raises
    ------
    InputError
        With every fault.
    """
    faults = FaultList(table)
    is_epoch, scale = False, None
    if plan.times.is_declared:
        parts = {part: _as_text(columns[own]) for part, own in plan.times.own.items()}
        t_ns, scale = declared_times(plan.times, parts, lambda i: f"{row_word} {i + 1}, column {plan.time}", faults)
    else:
        t_ns, is_epoch = _times(columns[plan.time], plan.time, row_word, faults, plan.times.form.spans)
    numbers: dict[str, Floats] = {}
    for own, name in plan.numbers.items():
        numbers[name] = _numbers(columns[own], own, row_word, faults)
    faults.raise_if_any()
    ignored = []
    for own, name in plan.housekeeping.items():
        silent = FaultList(table)
        values = _numbers(columns[own], own, row_word, silent)
        if silent.count or np.isnan(values).all():
            ignored.append(own)
        else:
            numbers[name] = values
    good = None if plan.validity is None else plan.validity.is_good(columns[plan.validity.column])
    return RawTable(t_ns, is_epoch, numbers, tuple(ignored), scale, good)


def _as_text(cells: Cells) -> pa.ChunkedArray:
    return pa.chunked_array([pa.array([None if cell is None else str(cell) for cell in cells], pa.string())])


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(cells: Cells, own: str, row_word: str, faults: FaultList) -> Floats:
    values = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        if cell is None:
            continue
        if not isinstance(cell, int | float) or isinstance(cell, bool):
            why = "JSON has no such number" if isinstance(cell, _NotJson) else f"{_kind(cell)}, want a number or null"
            faults.add(TelemetryValueError, f"{row_word} {i + 1}, column {own}", why, cell)
            continue
        values[i] = _bounded(cell)
        if math.isinf(values[i]):
            faults.add(TelemetryValueError, f"{row_word} {i + 1}, column {own}", "the number is too large", cell)
    return values


def _bounded(number: float) -> float:
    try:
        return float(number)
    except OverflowError:
        return math.inf


def _times(cells: Cells, own: str, row_word: str, faults: FaultList, spans: Spans) -> tuple[Nanoseconds, bool]:
    first = next((cell for cell in cells if cell is not None), "")
    if _is_number(first):
        seconds = np.full(len(cells), np.nan)
        for i, cell in enumerate(cells):
            if isinstance(cell, int | float) and not isinstance(cell, bool):
                seconds[i] = _bounded(cell)
            elif cell is not None:
                why = f"{_kind(cell)} in a column of epoch seconds"
                faults.add(TimeError, f"{row_word} {i + 1}, column {own}", why, cell)
        return epoch_ns(seconds, spans), True
    texts: list[tuple[str, str | None]] = []
    for i, cell in enumerate(cells):
        where = f"{row_word} {i + 1}, column {own}"
        is_text = isinstance(cell, str) and not isinstance(cell, _NotJson)
        if cell is not None and not is_text:
            faults.add(TimeError, where, f"{_kind(cell)} in a column of ISO 8601 times", cell)
        texts.append((where, cell if isinstance(cell, str) and is_text else None))
    return parse_times(texts, faults, spans), False


def _kind(value: object) -> str:
    names = {
        bool: "true or false",
        str: "text",
        list: "an array",
        dict: "an object",
        int: "a number",
        float: "a number",
    }
    return names.get(type(value), str(value))

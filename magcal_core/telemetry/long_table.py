"""Long tables: a row is one value of one parameter at one time. They are spread out to a column a parameter."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry import yamcs
from magcal_core.telemetry.arrow_numbers import floats_of, is_numeric, is_text
from magcal_core.telemetry.columns import (
    MAX_COLUMNS,
    READING,
    STANDARD,
    TIME,
    ColumnMap,
    TableForm,
    normal_header,
    plan_columns,
)
from magcal_core.telemetry.table import RawTable, from_arrow

PARAMETER: Final = ("parameter", "param", "parameter_name", "name", "channel", "variable", "mnemonic", "key", "signal")
VALUE: Final = ("value", "val", "eng_value", "engvalue", "engineering_value", "measurement", "raw_value", "rawvalue")
TIMES: Final = ("time", "timestamp", "generation_time", "generationtime", "datetime", "utc", "ts", "date")


@dataclass(frozen=True, slots=True)
class LongColumns:
    """The table's own names of the three columns of a long table."""

    time: str
    parameter: str
    value: str


def long_columns(header: Sequence[str], columns: ColumnMap | None) -> LongColumns | None:
    """Return the columns of a long table, None where the table is another.

    The keys ``parameter`` and ``value`` of the column map name them; without these, the usual names tell a long table
    that has no column of the readings.
    """
    given = dict(columns or {})
    is_told = "parameter" in given and "value" in given
    own = {given.get(name, name) for name in READING}
    if not is_told and own & set(header):
        return None
    names = {name.casefold().replace(" ", "_"): name for name in reversed(header) if name}
    parameter = given.get("parameter") or _first(PARAMETER, names)
    value = given.get("value") or _first(VALUE, names)
    time = next((given[key] for key in given if key == TIME or key.startswith("time_")), None)
    if time is None or time not in header:
        time = _first(TIMES, names)
    if parameter is None or value is None or time is None or len({parameter, value, time} & set(header)) < 3:
        return None
    return LongColumns(time, parameter, value)


def _first(known: Sequence[str], names: Mapping[str, str]) -> str | None:
    return next((names[name] for name in known if name in names), None)


def long_to_raw(
    table: pa.Table, long: LongColumns, columns: ColumnMap | None, form: TableForm, *, name: str
) -> RawTable:
    """Return a long table as a raw one: the rows that have a reading, slow parameters held from the row before.

    Raises
    ------
    InputError
        What a table with a column a parameter raises.
    """
    wide = spread(table, long)
    plan = plan_columns(wide.column_names, column_map(wide.column_names, long, columns), table=name, form=form)
    times = wide.column(long.time)
    if not plan.times.is_declared and is_text(times.type):
        with contextlib.suppress(pa.ArrowInvalid):
            wide = wide.set_column(0, long.time, times.cast(pa.float64()))
    return yamcs.at_readings(from_arrow(wide, plan, name=name))


def spread(table: pa.Table, long: LongColumns) -> pa.Table:
    """Return a long table with one column a parameter, a row a time, in the order in which times occur.

    Values that are no numbers are empty cells.

    Raises
    ------
    TelemetryFormatError
        There are more parameters than a table may have columns.
    """
    import pyarrow.compute as pc

    stamps = table.column(long.time).combine_chunks().dictionary_encode()
    keys = table.column(long.parameter).cast(pa.string()).combine_chunks().dictionary_encode()
    stamps = stamps.chunk(0) if isinstance(stamps, pa.ChunkedArray) else stamps
    keys = keys.chunk(0) if isinstance(keys, pa.ChunkedArray) else keys
    names = normal_header([str(name) for name in keys.dictionary.to_pylist()])
    if len(names) + 1 > MAX_COLUMNS:
        raise TelemetryFormatError(f"the long table has {len(names)} parameters; the limit is {MAX_COLUMNS - 1}")
    values = table.column(long.value)
    numbers = floats_of(values) if is_numeric(values.type) else _numbers(values)
    known = pc.and_(pc.is_valid(stamps), pc.is_valid(keys))
    is_known = np.array(known.to_pylist(), bool)
    row = np.array(stamps.indices.fill_null(0).to_pylist(), np.intp)
    column = np.array(keys.indices.fill_null(0).to_pylist(), np.intp)
    wide = np.full((len(names), len(stamps.dictionary)), np.nan)
    wide[column[is_known], row[is_known]] = numbers[is_known]
    columns = {long.time: stamps.dictionary}
    for name, cells in zip(names, wide, strict=True):
        if name and name not in columns:
            columns[name] = pa.array(cells, mask=np.isnan(cells))
    return pa.table(columns)


def _numbers(values: pa.ChunkedArray) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    numbers = np.full(len(values), np.nan)
    for i, text in enumerate(values.to_pylist()):
        try:
            numbers[i] = float(str(text).replace(",", "."))
        except ValueError:
            continue
    return numbers


def column_map(header: Sequence[str], long: LongColumns, columns: ColumnMap | None) -> dict[str, str]:
    """Return the column map of the table spread out: the last part of a parameter's name counts where it is one's own.

    ``/SAT/MGM/bx``, ``MGM.bx`` and ``bx`` all are ``bx``, unless the map or another parameter has that name.
    """
    last = {own: own.replace("/", ".").rpartition(".")[2] for own in header}
    counts = Counter(last.values())
    given = {name: own for name, own in (columns or {}).items() if name not in ("parameter", "value")}
    qualified = {short: own for own, short in last.items() if counts[short] == 1}
    given = {name: own if own in header else qualified.get(own, own) for name, own in given.items()}
    told = {
        name: qualified[name]
        for name in STANDARD
        if name in qualified and name not in given and name not in header and qualified[name] not in given.values()
    }
    is_timed = any(key == TIME or key.startswith("time_") for key in given)
    return ({} if is_timed else {TIME: long.time}) | told | given

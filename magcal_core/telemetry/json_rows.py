"""Rows of JSON objects, one an object a sample: nested members become columns, ``{"mag": {"x": 1}}`` is ``mag.x``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import pyarrow as pa

from magcal_core.telemetry.columns import (
    MAX_COLUMNS,
    STANDARD,
    ColumnMap,
    TableForm,
    checked_map,
    own_names,
    plan_columns,
)
from magcal_core.telemetry.json_cells import to_raw_table
from magcal_core.telemetry.long_table import long_columns, long_to_raw
from magcal_core.telemetry.table import RawTable

Row = Mapping[str, object]

MOST_LEVELS: Final = 5
"""Members nested deeper are left aside."""
MOST_COMPONENTS: Final = 16
"""Longest array whose cells become columns."""
USUAL_SHARE: Final = 0.5
"""A nested member in a smaller share of the rows is no column."""
_INDEX: Final = re.compile(r"\[(\d+)\]")


def rows_to_raw(
    rows: Sequence[Row], columns: ColumnMap | None, form: TableForm, *, row_word: str, table: str, bad_rows: int = 0
) -> RawTable:
    """Return JSON objects as a raw table; raise with every fault among them.

    Raises
    ------
    InputError
        With every fault.
    """
    header = list({name: None for row in rows for name in row})
    if (long := long_columns(header, columns)) is not None:
        cells = {name: _texts(rows, name) for name in (long.time, long.parameter, long.value)}
        return replace(long_to_raw(pa.table(cells), long, columns, form, name=f"long {table}"), bad_rows=bad_rows)
    plain = set(own_names(checked_map(columns)).values())
    if any(isinstance(cell, dict | list) and name not in plain for row in rows for name, cell in row.items()):
        rows = [dict(_flat(row, plain)) for row in rows]
        rows, header = _short_names(rows, plain)
        columns = {name: _dotted(own, header) for name, own in (columns or {}).items()}
    plan = plan_columns(header, columns, table=table, form=form)
    whole = {name: [row.get(name) for row in rows] for name in header}
    return replace(to_raw_table(whole, plan, row_word=row_word, table=table), bad_rows=bad_rows)


def _texts(rows: Sequence[Row], name: str) -> pa.Array:
    cells = [row.get(name) for row in rows]
    return pa.array([None if cell is None else str(cell) for cell in cells], pa.string())


def _flat(row: Row, plain: set[str], above: str = "", level: int = 0) -> Iterator[tuple[str, object]]:
    """Yield the members of a row, those of objects and of short arrays one by one; names in ``plain`` stay whole."""
    for name, cell in row.items():
        own = f"{above}{name}"
        nested: Mapping[str, object] | None = None
        if own not in plain and level < MOST_LEVELS:
            if isinstance(cell, dict):
                nested = cell
            elif isinstance(cell, list) and 0 < len(cell) <= MOST_COMPONENTS:
                nested = {str(i): one for i, one in enumerate(cell)}
        if nested is None:
            yield own, cell
        else:
            yield from _flat(nested, plain, f"{own}.", level + 1)


def _short_names(rows: Sequence[Row], plain: set[str]) -> tuple[list[Row], list[str]]:
    """Return the rows with standard names where a nested member's last part is one, and the columns that are usual."""
    counts = Counter(name for row in rows for name in row)
    last = {name: name.rpartition(".")[2] for name in counts if "." in name}
    times = Counter(last.values())
    short = {
        name: end
        for name, end in last.items()
        if end in STANDARD and end in plain and end not in counts and times[end] == 1
    }
    usual = [name for name, count in counts.items() if "." not in name or count >= USUAL_SHARE * len(rows)]
    header = [short.get(name, name) for name in usual][: MAX_COLUMNS + 1]
    return [{short.get(name, name): cell for name, cell in row.items()} for row in rows], header


def _dotted(own: str, header: Sequence[str]) -> str:
    """Return an own name such as ``b[0]`` as the columns have it, ``b.0``."""
    return own if own in header else _INDEX.sub(r".\1", own)

"""Parameter exports of the mission control system Yamcs, as they come: CSV with ``Time`` and qualified names.

Notes
-----
A row of an export holds the parameters of one packet, and its other cells are empty: a temperature that comes every
minute stands in rows of its own. Readings make the samples here; slow housekeeping is held from the row that had it
last, as Yamcs does where it keeps values. Attitude, reference and position are not held: an old one is a wrong one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.telemetry.columns import READING, STANDARD, TIME, ColumnMap
from magcal_core.telemetry.table import RawTable

TIME_COLUMN: Final = "Time"


def is_export(header: Sequence[str]) -> bool:
    """Return whether a table with this header is a parameter export: its time, then qualified names."""
    return header[:1] == [TIME_COLUMN] and any(name.startswith("/") for name in header[1:])


def column_map(header: Sequence[str], columns: ColumnMap | None) -> dict[str, str]:
    """Return ``columns`` with what the names of an export tell by themselves.

    The last part of a qualified name stands for the whole where no other parameter has it: ``/SAT/MGM/bx`` is ``bx``.
    """
    last = {own: own.rpartition("/")[2] for own in header[1:]}
    counts = Counter(last.values())
    qualified = {short: own for own, short in last.items() if counts[short] == 1 and short not in header}
    given = {name: qualified.get(own, own) for name, own in (columns or {}).items()}
    taken = set(given.values())
    told = {short: own for short, own in qualified.items() if short not in given and own not in taken}
    return {TIME: TIME_COLUMN, **told, **given}


def at_readings(table: RawTable) -> RawTable:
    """Return the rows that have a reading; housekeeping is the last before or at each."""
    has_reading = np.any([np.isfinite(table.numbers[name]) for name in READING], axis=0)
    numbers: Mapping[str, Floats] = {
        name: (column if name in STANDARD else _held(column))[has_reading] for name, column in table.numbers.items()
    }
    return RawTable(table.t_ns[has_reading], table.is_epoch, numbers, table.ignored)


def _held(column: Floats) -> Floats:
    """Return a column with each missing value replaced by the last one above it, or the first one where none is."""
    given = np.flatnonzero(np.isfinite(column))
    if given.size == 0:
        return column
    rows = np.searchsorted(given, np.arange(len(column)), side="right") - 1
    return column[given[np.maximum(rows, 0)]]

"""RC as DTU Space gives it: a row an hour, the index and its external and induced part [RC]_."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.index_files.rows import Rows, data_lines, number_of

MJD2000_NS: Final = int(np.datetime64("2000-01-01", "ns").astype(np.int64))
AGREEMENT_NT: Final = 0.01
"""How far RC may be from the sum of its parts, which are rounded: nT."""
_COLUMNS: Final = ("time", "RC", "RC_e", "RC_i")


def read(text: str, sha256: str) -> Index:
    """Return the index of a file with the columns ``time RC RC_e RC_i flag``, time the middle of the hour in MJD2000.

    Raises
    ------
    IndexFormatError
        A row is short or has a letter, a time is no middle of an hour, or RC is not the sum of its parts.
    """
    rows, lines = Rows(HOUR_NS), data_lines(text)
    table = _table(lines)
    add_hours(rows, [line for line, _ in lines], table if table is not None else _checked(rows, lines))
    return rows.index("RC", "dtu-rc", sha256)


def _table(lines: Sequence[tuple[int, str]]) -> Floats | None:
    """Return the numbers of all lines, shape (n, 4), read at once; None where one may be at fault."""
    widths = {len(line.split()) for _, line in lines}
    if not widths <= {4, 5}:
        return None
    try:
        table = np.loadtxt([line for _, line in lines], usecols=range(4), ndmin=2, comments=None)
    except ValueError:
        return None
    return table if np.isfinite(table).all() else None


def _checked(rows: Rows, lines: Sequence[tuple[int, str]]) -> Floats:
    """Return the same, shape (n, 4), line by line; what cannot be read is noted and NaN."""
    table = np.full((len(lines), 4), np.nan)
    for row, (line, text) in enumerate(lines):
        cells = text.split()
        numbers = [number_of(cell) for cell in cells[:4]]
        if not len(_COLUMNS) <= len(cells) <= len(_COLUMNS) + 1:
            rows.refuse(line, f"{len(cells)} columns; want time RC RC_e RC_i flag")
        elif None in numbers:
            at = numbers.index(None)
            rows.refuse(line, f"{_COLUMNS[at]}: want a number", cells[at])
        else:
            table[row] = [np.nan if number is None else number for number in numbers]
    return table


def add_hours(rows: Rows, lines: Sequence[int], table: Floats) -> None:
    """Note the hours of ``table``, (n, 4): middle, days since 2000, RC, its parts, nT; NaN rows are passed over."""
    is_given = np.isfinite(table).all(axis=1)
    minutes = np.rint(np.where(is_given, np.clip(table[:, 0], -1e5, 1e5), 0.0) * 1440.0).astype(np.int64)
    is_middle = (minutes % 60 == 30) & (np.abs(table[:, 0]) < 1e5)
    for row in np.flatnonzero(is_given & ~is_middle).tolist():
        why = "the time is not the middle of an hour, to the minute, in days since 2000"
        rows.refuse(lines[row], why, f"{table[row, 0]:.6f}")
    total_nt = table[:, 2] + table[:, 3]
    is_sum = np.abs(total_nt - table[:, 1]) <= AGREEMENT_NT + 1e-9
    for row in np.flatnonzero(is_given & is_middle & ~is_sum).tolist():
        rows.refuse(lines[row], f"RC is {table[row, 1]:g} nT, the sum of its parts {total_nt[row]:g} nT")
    good = np.flatnonzero(is_given & is_middle & is_sum)
    start_ns = MJD2000_NS + (minutes[good] - 30) * 60_000_000_000
    rows.add_all([lines[row] for row in good.tolist()], start_ns, [table[good, column] for column in (1, 2, 3)])

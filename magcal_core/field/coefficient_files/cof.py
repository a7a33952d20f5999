"""Coefficients as the World Magnetic Model has them, WMMHR too: values at an epoch and their change a year [WMM]_."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.field.coefficient_files.table import (
    Faults,
    check_degrees,
    empty,
    number,
    whole,
    year_ns,
)
from magcal_core.field.coefficients import CoefficientFile

VALID_YEARS: Final = 5
_END: Final = "9999"


def is_header(cells: Sequence[str]) -> bool:
    """Return whether the cells are the first line of such a file: an epoch, and a name that is no number."""
    return len(cells) >= 2 and "." in cells[0] and number(cells[0]) is not None and number(cells[1]) is None


def read(text: str, name: str | None, sha256: str) -> CoefficientFile:
    """Return the coefficients of a file: epoch, name, date; rows ``n m g h g' h'``; a line of 9s.

    Raises
    ------
    FieldFileError
        A pair (n, m) is missing or there twice, a value is no number, or the line of 9s is missing.
    """
    faults = Faults("cof")
    lines = [(line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]
    line, head = lines[0]
    epoch = number(head[0])
    if epoch is None or year_ns(epoch) is None or year_ns(epoch + VALID_YEARS) is None:
        faults.add(line, "the epoch is no decimal year", head[0])
    end = next((i for i, (_, cells) in enumerate(lines) if _is_end(cells)), None)
    if end is None:
        faults.add(lines[-1][0], "the line of 9s at the end is missing: the file is cut short")
    faults.raise_if_any()
    rows = _rows(faults, lines[1:end])
    degrees = [n for n, _ in rows] or [0]
    low, high = min(degrees), max(degrees)
    check_degrees(faults, line, low, high)
    for n in range(low, high + 1):
        absent = next((m for m in range(n + 1) if (n, m) not in rows), None)
        if absent is not None:
            faults.add(lines[-1][0], f"degree {n} is not complete: ({n}, {absent}) is missing")
    faults.raise_if_any()
    values, change = empty(2, high), empty(2, high)
    for (n, m), (g, h, g_year, h_year) in rows.items():
        values[0][:, n, m], change[0][:, n, m] = g, g_year
        values[1][:, n, m], change[1][:, n, m] = h, h_year
    knots = _knots(float(epoch or 0.0))
    g_nt, h_nt = (_lines(a[0], b[0], knots - float(epoch or 0.0)) for a, b in zip(values, change, strict=True))
    breaks_ns = np.array([year_ns(year) for year in knots], np.int64)
    return CoefficientFile(name, "cof", head[1], sha256, low, high, 2, breaks_ns, g_nt, h_nt)


def _is_end(cells: Sequence[str]) -> bool:
    return set("".join(cells)) == {"9"} and cells[0].startswith(_END)


def _rows(faults: Faults, lines: Sequence[tuple[int, list[str]]]) -> dict[tuple[int, int], list[float]]:
    """Return g, h and their change a year by (n, m)."""
    rows: dict[tuple[int, int], list[float]] = {}
    for line, cells in lines:
        n, m = (whole(cell) for cell in cells[:2]) if len(cells) == 6 else (None, None)
        if n is None or m is None or not 0 <= m <= n or n < 1:
            faults.add(line, "want n m g h g' h'", " ".join(cells[:6]))
            continue
        values = [number(cell) for cell in cells[2:]]
        found = [value for value in values if value is not None]
        if len(found) < len(values):
            faults.add(line, f"({n}, {m}): a value is not a number", cells[2 + values.index(None)])
        elif (n, m) in rows:
            faults.add(line, f"({n}, {m}) is there twice")
        rows.setdefault((n, m), found)
    faults.raise_if_any()
    return rows


def _knots(epoch: float) -> Floats:
    """Return epoch, every 1 January of the five years, and their end: between them a decimal year is linear in time."""
    years = np.arange(np.floor(epoch) + 1.0, np.ceil(epoch + VALID_YEARS))
    return np.concatenate([[epoch], years, [epoch + VALID_YEARS]])


def _lines(value: Floats, change: Floats, years: Floats) -> Floats:
    """Return the lines between ``years`` from the epoch, shape (p, 2, N + 1, N + 1)."""
    at = value + years[:, None, None] * change
    return np.stack([at[:-1], np.diff(at, axis=0)], axis=1)

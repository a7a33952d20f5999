"""Coefficients as `.shc` files have them: IGRF, CHAOS, models of the crust; splines and all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.field.coefficient_files.table import (
    Faults,
    check_complete,
    check_degrees,
    empty,
    number,
    whole,
    year_ns,
)
from magcal_core.field.coefficients import ALWAYS_NS, CoefficientFile

MOST_ORDER: Final = 12
_OTHER_YEARS: Final = "decimal years format (false)"
"""In a comment: years are 2000 + days/365.25, as chaosmagpy writes them."""

_Lines = Sequence[tuple[int, str]]


def is_header(cells: Sequence[str]) -> bool:
    """Return whether the cells are the first line of such a file: five whole numbers."""
    return len(cells) >= 5 and all(whole(cell) is not None for cell in cells[:5])


def read(text: str, name: str | None, sha256: str) -> CoefficientFile:
    """Return the coefficients of a file.

    Raises
    ------
    FieldFileError
        A pair (n, m) is missing or there twice, a value is no number, or there are fewer times than one piece has.
    """
    faults = Faults("shc")
    numbered = [(line, row.strip()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]
    comments = [row.lstrip("#").strip() for _, row in numbered if row.startswith("#")]
    lines = [(line, row) for line, row in numbered if not row.startswith("#")]
    line, head = lines[0]
    low, high, count, order, step = (int(cell) for cell in head.split()[:5])
    check_degrees(faults, line, low, high)
    if not 1 <= order <= MOST_ORDER:
        faults.add(line, f"order {order}; want 1 to {MOST_ORDER}")
    elif order > 1 and step != order - 1:
        faults.add(line, f"step {step}; want {order - 1}, one less than the order")
    if count < max(order, 1):
        faults.add(line, f"order {order} needs {order} times for a piece, {count} are there")
    faults.raise_if_any()
    is_calendar = not any(_OTHER_YEARS in comment.lower() for comment in comments)
    times_ns = _times_ns(faults, lines[1:2], count, is_calendar=is_calendar)
    g_nt, h_nt = _values(faults, lines[2:], low, high, count)
    faults.raise_if_any()
    breaks_ns, coefficients = _pieces(times_ns, np.stack([g_nt, h_nt]), order)
    model = next((comment for comment in comments if comment), None)
    return CoefficientFile(name, "shc", model, sha256, low, high, order, breaks_ns, *coefficients)


def _times_ns(faults: Faults, lines: _Lines, count: int, *, is_calendar: bool) -> Nanoseconds:
    line, row = lines[0] if lines else (1, "")
    cells = row.split()
    years = [number(cell) for cell in cells]
    stamps = [None if year is None else year_ns(year, is_calendar=is_calendar) for year in years]
    if len(cells) != count:
        faults.add(line, f"{len(cells)} times; the first line says {count}")
    elif None in stamps:
        at = stamps.index(None)
        faults.add(line, f"time {at + 1} is no decimal year", cells[at])
    faults.raise_if_any()
    times_ns = np.array(stamps, np.int64)
    if np.any(np.diff(times_ns) <= 0):
        faults.add(line, "the times do not ascend")
    faults.raise_if_any()
    return times_ns


def _values(faults: Faults, lines: _Lines, low: int, high: int, count: int) -> tuple[Floats, Floats]:
    """Return g and h at the times, each of shape (times, N + 1, N + 1)."""
    g_nt, h_nt = empty(count, high)
    seen: dict[tuple[int, int], int] = {}
    for line, row in lines:
        cells = row.split()
        pair = [whole(cell) for cell in cells[:2]]
        n, m = (pair[0], pair[1]) if len(pair) == 2 else (None, None)
        if n is None or m is None or not (low <= n <= high and abs(m) <= n):
            faults.add(line, f"want degree {low} to {high} and order, then {count} values", " ".join(cells[:2]))
            continue
        if (n, m) in seen:
            faults.add(line, f"({n}, {m}) is there twice, first in line {seen[n, m]}")
            continue
        seen[n, m] = line
        values = [number(cell) for cell in cells[2:]]
        if len(values) != count:
            faults.add(line, f"({n}, {m}) has {len(values)} values for {count} times")
        elif None in values:
            faults.add(line, f"({n}, {m}): a value is not a number", cells[2 + values.index(None)])
        else:
            (g_nt if m >= 0 else h_nt)[:, n, abs(m)] = values
    check_complete(faults, seen, low, high)
    return g_nt, h_nt


def _pieces(times_ns: Nanoseconds, values: Floats, order: int) -> tuple[Nanoseconds, Floats]:
    """Return the breaks and the polynomials, shape (2, p, order, N + 1, N + 1), through ``values``, (2, times, ..)."""
    if order == 1:
        if len(times_ns) == 1:
            return np.array(ALWAYS_NS, np.int64), values[:, :, None]
        # The last value holds at its own instant alone.
        return np.append(times_ns, times_ns[-1] + 1), values[:, :, None]
    step = order - 1
    breaks = np.arange(0, len(times_ns) - len(times_ns) % step + 1, step)
    breaks = breaks[breaks < len(times_ns)]
    pieces = []
    for first in breaks[:-1]:
        rows = slice(first, first + order)
        stamps = times_ns[rows]
        share = (stamps - stamps[0]) / (stamps[-1] - stamps[0])
        away = values[:, rows] - values[:, first, None]
        vander = np.vander(share[1:], order, increasing=True)[:, 1:]
        powers = np.asarray(np.linalg.solve(vander, _flat(away[:, 1:])), np.float64)
        pieces.append(np.concatenate([values[:, first, None], _shaped(powers, away.shape)], axis=1))
    return times_ns[breaks], np.stack(pieces, axis=1)


def _flat(values: Floats) -> Floats:
    """Return (2, times, ..) as (times, everything else)."""
    return np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)


def _shaped(powers: Floats, shape: tuple[int, ...]) -> Floats:
    """Return the same the other way round."""
    return np.moveaxis(powers.reshape(len(powers), shape[0], *shape[2:]), 0, 1)

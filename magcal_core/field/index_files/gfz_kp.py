"""Kp, Hp60 and Hp30 as GFZ Potsdam gives them: a row an interval [KP]_."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

import numpy as np

from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.index_files.rows import LARGEST_KP, Rows, data_lines, number_of

_COLUMNS: Final = ("year", "month", "day", "start", "middle", "days", "days_m", "Kp", "ap")
_MISSING: Final = -1.0
_STEPS_H: Final = (3.0, 1.0, 0.5)
"""Intervals of Kp, Hp60 and Hp30, hours."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def read(text: str, sha256: str) -> Index:
    """Return the index of a file with the columns ``YYYY MM DD hh.h hh._m days days_m Kp ap D``.

    Raises
    ------
    IndexFormatError
        A row is short or has a letter, there is no such day, intervals are not whole, or Kp is outside 0 to 9 (Hp30 and
        Hp60 have no upper limit).
    """
    lines = data_lines(text)
    step_h = _step_h(lines[0][1]) if lines else 3.0
    rows = Rows(round(step_h * HOUR_NS))
    for line, row in lines:
        _add(rows, line, row.split(), step_h)
    return rows.index("Kp", "gfz-kp", sha256, largest=LARGEST_KP if step_h == 3.0 else np.inf)


def _step_h(row: str) -> float:
    """Return the interval, hours, that start and middle in the first row tell; 3 where they tell none."""
    cells = row.split()
    ends = [number_of(cell) for cell in cells[3:5]]
    if len(ends) < 2 or ends[0] is None or ends[1] is None:
        return 3.0
    step_h = 2.0 * (ends[1] - ends[0])
    return step_h if step_h in _STEPS_H else 3.0


def _add(rows: Rows, line: int, cells: list[str], step_h: float) -> None:
    if not len(_COLUMNS) <= len(cells) <= len(_COLUMNS) + 1:
        rows.refuse(line, f"{len(cells)} columns; want YYYY MM DD hh.h hh._m days days_m Kp ap D")
        return
    numbers: list[float] = []
    for name, cell in zip(_COLUMNS, cells, strict=False):
        number = number_of(cell)
        if number is None:
            rows.refuse(line, f"{name}: want a number", cell)
            return
        numbers.append(number)
    year, month, day, hour, middle = numbers[:5]
    try:
        if not all(cell.isdigit() for cell in cells[:3]):
            raise ValueError("not whole")
        whole = datetime(int(year), int(month), int(day), tzinfo=UTC)
    except ValueError:
        rows.refuse(line, "there is no such day", " ".join(cells[:3]))
        return
    if not (0.0 <= hour < 24.0 and hour % step_h == 0.0 and 2.0 * (middle - hour) == step_h):
        rows.refuse(line, f"hours {hour:g}, middle {middle:g}: want whole steps of {step_h:g} h")
        return
    start_ns = (whole - _EPOCH).days * 24 * HOUR_NS + round(hour * HOUR_NS)
    rows.add(line, start_ns, np.nan if numbers[7] == _MISSING else numbers[7])

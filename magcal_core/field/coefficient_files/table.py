"""What the readers share: rows of coefficients in, complete arrays or every fault out; years as instants."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, FieldFileError
from magcal_core.field.coefficients import MOST_DEGREE

_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WHOLE: Final = re.compile(r"[+-]?\d{1,6}", re.ASCII)
_SHOWN: Final = 60
_MOST_FAULTS: Final = 100
_FIRST_YEAR, _LAST_YEAR = 1678, 2261
_J2000_NS: Final = int(np.datetime64("2000-01-01", "ns").astype(np.int64))
_DAY_NS: Final = 86_400_000_000_000


@dataclass(slots=True)
class Faults:
    """What is wrong in a file, line by line."""

    kind: str
    found: list[Fault] = field(default_factory=list)

    def add(self, line: int, why: str, value: str | None = None) -> None:
        """Note a fault of a line."""
        self.found.append(Fault(f"line {line}", why, None if value is None else value[:_SHOWN]))

    def raise_if_any(self) -> None:
        """Raise every fault that was noted.

        Raises
        ------
        FieldFileError
            There was one.
        """
        if self.found:
            first, count = self.found[0], len(self.found)
            noun = "fault" if count == 1 else "faults"
            message = f"{count} {noun} in the field file ({self.kind}); first: {first.where}: {first.why}"
            raise FieldFileError(message, self.found[:_MOST_FAULTS])


def number(text: str) -> float | None:
    """Return the plain decimal number that ``text`` is, None where it is none or too large."""
    found = float(text) if _NUMBER.fullmatch(text) else np.nan
    return found if np.isfinite(found) else None


def whole(text: str) -> int | None:
    """Return the whole number that ``text`` is, or None."""
    return int(text) if _WHOLE.fullmatch(text) else None


def check_degrees(faults: Faults, line: int, min_degree: int, max_degree: int) -> None:
    """Raise where the degrees are none that a field has.

    Raises
    ------
    FieldFileError
        They are not 1 to `MOST_DEGREE`, in order.
    """
    if not 1 <= min_degree <= max_degree <= MOST_DEGREE:
        faults.add(line, f"degrees {min_degree} to {max_degree}; want 1 to {MOST_DEGREE} at most, in order")
    faults.raise_if_any()


def check_complete(faults: Faults, lines: dict[tuple[int, int], int], min_degree: int, max_degree: int) -> None:
    """Note each pair (n, m) that is missing; ``lines``: the line of each that is there."""
    for n in range(min_degree, max_degree + 1):
        for m in range(-n, n + 1):
            if (n, m) not in lines:
                last = max(lines.values(), default=1)
                faults.add(last, f"degree {n} is not complete: ({n}, {m}) is missing")
                break


def year_ns(year: float, *, is_calendar: bool = True) -> int | None:
    """Return the instant of a decimal year, nanoseconds since 1970; None where it is far from ours.

    ``is_calendar``: the year's own length; else 365.25 days from 2000 on.
    """
    if not _FIRST_YEAR <= year <= _LAST_YEAR:
        return None
    if not is_calendar:
        return _J2000_NS + _to_ms((year - 2000.0) * 365.25 * _DAY_NS)
    start, end = (int(np.datetime64(f"{int(year) + step}-01-01", "ns").astype(np.int64)) for step in (0, 1))
    return start + _to_ms((year - int(year)) * (end - start))


def _to_ms(elapsed_ns: float) -> int:
    """Return a time rounded to the millisecond: a year with eight decimals is known to a third of a second."""
    return round(elapsed_ns / 1e6) * 1_000_000


def empty(sets: int, max_degree: int) -> tuple[Floats, Floats]:
    """Return arrays of zeros for g and h, each of shape (sets, N + 1, N + 1)."""
    shape = (sets, max_degree + 1, max_degree + 1)
    return np.zeros(shape), np.zeros(shape)

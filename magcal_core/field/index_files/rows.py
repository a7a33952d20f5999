"""What the readers share: rows with their line numbers in, a sound index or every fault out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import Fault, IndexFormatError, InputError, TimeZoneMissingError
from magcal_core.field.index import Index

LARGEST_NT: Final = 2000.0
"""Largest value of RC or Dst, nT: the storm of 1859 is put at 900 to 1750."""
LARGEST_KP: Final = 9.0
_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_SHOWN: Final = 60
_MOST_FAULTS: Final = 100


@dataclass(slots=True)
class Rows:
    """Intervals as they are read; `index` checks them all and makes an index of them.

    ``line``: number of the line of each row; ``rank``: of two rows of one interval the one with the higher rank holds.
    """

    step_ns: int
    line: list[int] = field(default_factory=list)
    start_ns: list[int] = field(default_factory=list)
    value: list[float] = field(default_factory=list)
    external_nt: list[float] = field(default_factory=list)
    induced_nt: list[float] = field(default_factory=list)
    rank: list[int] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)
    has_no_zone: bool = False

    def add(self, line: int, start_ns: int, value: float, parts: tuple[float, float] | None = None) -> None:
        """Note one interval; NaN: without a value."""
        external, induced = (np.nan, np.nan) if parts is None else parts
        self.line.append(line)
        self.start_ns.append(start_ns)
        self.value.append(value)
        self.external_nt.append(external)
        self.induced_nt.append(induced)

    def add_all(self, line: Sequence[int] | range, start_ns: Nanoseconds, columns: Sequence[Floats]) -> None:
        """Note many intervals at once: value alone, or value, external and induced part."""
        none = np.full(len(start_ns), np.nan)
        value, external, induced = columns if len(columns) == 3 else (columns[0], none, none)
        self.line += line
        self.start_ns += start_ns.tolist()
        self.value += value.tolist()
        self.external_nt += external.tolist()
        self.induced_nt += induced.tolist()

    def refuse(self, line: int, why: str, value: str | None = None) -> None:
        """Note a fault of a line."""
        self.faults.append(Fault(f"line {line}", why, None if value is None else value[:_SHOWN]))

    def index(self, name: str, kind: str, sha256: str, *, largest: float = LARGEST_NT) -> Index:
        """Return the index, its intervals in the order of time.

        Raises
        ------
        IndexFormatError
            A row cannot be what it says, two of them differ about one interval, or there is none.
        TimeZoneMissingError
            A time has no zone.
        """
        start_ns = np.array(self.start_ns, np.int64)
        columns = [np.array(column, np.float64) for column in (self.value, self.external_nt, self.induced_nt)]
        lines = np.array(self.line, np.int64)
        self._check_values(columns, lines, name, largest)
        rank = np.array(self.rank, np.int64) if self.rank else np.zeros(len(lines), np.int64)
        # Of one interval: the highest rank first, and a value before none.
        order = np.lexsort((np.isnan(columns[0]), -rank, start_ns))
        start_ns, lines, rank = start_ns[order], lines[order], rank[order]
        columns = [column[order] for column in columns]
        is_again = np.concatenate([[False], start_ns[1:] == start_ns[:-1]]) if len(start_ns) else np.zeros(0, bool)
        self._check_conflicts(is_again, rank, columns[0], lines)
        self.raise_faults(kind)
        if not len(start_ns):
            raise IndexFormatError(f"no record of an index in the {kind} file")
        kept = ~is_again
        value, external, induced = (column[kept] for column in columns)
        return Index(name, kind, start_ns[kept], self.step_ns, value, external, induced, sha256)

    def _check_values(self, columns: list[np.ndarray], lines: np.ndarray, name: str, largest: float) -> None:
        lowest, unit = (0.0, "") if name == "Kp" else (-largest, " nT")
        for column in columns:
            for row in np.flatnonzero((column > largest) | (column < lowest)):
                limits = f"from {lowest:g}{unit}" + ("" if np.isinf(largest) else f" to {largest:g}{unit}")
                self.refuse(int(lines[row]), f"{column[row]:g}{unit} is no value of {name}; want {limits}")

    def _check_conflicts(self, is_again: np.ndarray, rank: np.ndarray, value: np.ndarray, lines: np.ndarray) -> None:
        first_of = np.maximum.accumulate(np.where(is_again, 0, np.arange(len(is_again))))
        for row in np.flatnonzero(is_again):
            first = first_of[row]
            differs = not np.isnan(value[row]) and value[row] != value[first] and rank[row] == rank[first]
            if differs:
                what = f"two values for one interval: {value[first]:g} in line {lines[first]}, and {value[row]:g}"
                self.refuse(int(lines[row]), what)

    def raise_faults(self, kind: str) -> None:
        """Raise every fault that was noted, the first hundred listed.

        Raises
        ------
        IndexFormatError, TimeZoneMissingError
            There was one.
        """
        if not self.faults:
            return
        self.faults.sort(key=lambda fault: int(fault.where.removeprefix("line ")))
        count, first = len(self.faults), self.faults[0]
        more = f", the first {_MOST_FAULTS} listed" if count > _MOST_FAULTS else ""
        noun = "fault" if count == 1 else "faults"
        message = f"{count} {noun} in the index file ({kind}){more}; first: {first.where}: {first.why}"
        error: type[InputError] = TimeZoneMissingError if self.has_no_zone else IndexFormatError
        raise error(message, self.faults[:_MOST_FAULTS])


def number_of(text: str) -> float | None:
    """Return the plain decimal number that ``text`` is, or None."""
    return float(text) if _NUMBER.fullmatch(text) else None


def data_lines(text: str) -> Sequence[tuple[int, str]]:
    """Return the lines that are neither empty nor comments, with their numbers from 1."""
    numbered = enumerate(text.splitlines(), 1)
    return [(number, line) for number, line in numbered if (bare := line.strip()) and not bare.startswith("#")]

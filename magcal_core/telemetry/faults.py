"""Every fault of a table, collected and raised once."""

from __future__ import annotations

import heapq
import re
from typing import Final

from magcal_core.errors import (
    Fault,
    InputError,
    TelemetryFormatError,
    TelemetryValueError,
    TimeError,
    TimeZoneMissingError,
)

FIRST_FAULTS: Final = 100
"""Faults that an error carries; the rest is counted."""
SHOWN_VALUE: Final = 60
"""Characters of a wrong value that a fault keeps."""
_ROW: Final = re.compile(r"(?:line|row) (\d+)")

_GRAVEST_FIRST: Final[tuple[type[InputError], ...]] = (
    TelemetryFormatError,
    TimeZoneMissingError,
    TimeError,
    TelemetryValueError,
)


class FaultList:
    """Faults of one table: the first hundred in the order of its rows are kept, all are counted.

    Readers go through a table column by column; whoever mends it goes from its first line to its last.
    """

    def __init__(self, table: str) -> None:
        self.table = table
        self.count = 0
        self._first: list[tuple[int, int, Fault]] = []
        self._kinds: set[type[InputError]] = set()

    def add(self, kind: type[InputError], where: str, why: str, value: object = None) -> None:
        """Note one fault; ``kind`` is the error that it alone would raise."""
        self.count += 1
        self._kinds.add(kind)
        row = _ROW.match(where)
        place = -int(row[1]) if row else 0, -self.count
        if len(self._first) == FIRST_FAULTS and place < self._first[0][:2]:
            return
        shown = None if value is None else str(value)[:SHOWN_VALUE]
        entry = (*place, Fault(where, why, shown))
        if len(self._first) < FIRST_FAULTS:
            heapq.heappush(self._first, entry)
        else:
            heapq.heapreplace(self._first, entry)

    @property
    def first(self) -> list[Fault]:
        """The faults that are kept, in the order of the rows, those of the table as a whole before them."""
        return [fault for *_, fault in sorted(self._first, key=lambda entry: entry[:2], reverse=True)]

    def raise_if_any(self) -> None:
        """Raise the gravest kind of error noted, with every fault kept.

        Raises
        ------
        InputError
            At least one fault was noted.
        """
        if not self.count:
            return
        kind = next((k for k in _GRAVEST_FIRST if k in self._kinds), InputError)
        noun = "fault" if self.count == 1 else "faults"
        more = "" if self.count <= FIRST_FAULTS else f", the first {FIRST_FAULTS} listed"
        kept = self.first
        raise kind(f"{self.count} {noun} in the {self.table}{more}; first: {kept[0].where}: {kept[0].why}", kept)

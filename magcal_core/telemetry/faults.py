"""Every fault of a table, collected and raised once."""

from __future__ import annotations

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
    """Faults of one table: the first hundred in the order of the table are kept, all are counted."""

    def __init__(self, table: str) -> None:
        self.table = table
        self.count = 0
        self._of_column: dict[str, list[Fault]] = {}
        self._kinds: set[type[InputError]] = set()

    def add(self, kind: type[InputError], where: str, why: str, value: object = None) -> None:
        """Note one fault; ``kind`` is the error that it alone would raise.

        Faults of one column are noted in the order of its rows; ``where`` is such as ``line 17, column by``.
        """
        self.count += 1
        self._kinds.add(kind)
        noted = self._of_column.setdefault(where.partition(", ")[2], [])
        if len(noted) < FIRST_FAULTS:
            shown = None if value is None else str(value)[:SHOWN_VALUE]
            noted.append(Fault(where, why, shown))

    @property
    def first(self) -> list[Fault]:
        """The first hundred faults, by row and then by column as they were noted."""
        kept = [fault for noted in self._of_column.values() for fault in noted]
        return sorted(kept, key=_row)[:FIRST_FAULTS]

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
        first = self.first
        message = f"{self.count} {noun} in the {self.table}{more}; first: {first[0].where}: {first[0].why}"
        raise kind(message, first)


def _row(fault: Fault) -> int:
    """Return the number of the row or line of a fault, 0 for one of the whole table."""
    number = re.match(r"(?:line|row) (\d+)", fault.where)
    return int(number[1]) if number else 0

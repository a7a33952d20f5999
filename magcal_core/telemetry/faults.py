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
SHOWN_IN_MESSAGE: Final = 40
"""Characters of a wrong value that the message of an error repeats."""
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
        self.advice = ""
        self._of_column: dict[str, list[Fault]] = {}
        self._kinds: set[type[InputError]] = set()

    def add(self, kind: type[InputError], where: str, why: str, value: object = None) -> None:
        """Note one fault; ``kind`` is the error that it alone would raise.

        Faults of one column are noted in the order of its rows; ``where`` is such as ``line 17, column by``.
        """
        self.count += 1
        self._kinds.add(kind)
        where, why = printable(where), printable(why)
        noted = self._of_column.setdefault(where.partition(", ")[2], [])
        if len(noted) < FIRST_FAULTS:
            shown = None if value is None else str(value)[:SHOWN_VALUE]
            noted.append(Fault(where, why, shown))

    def advise(self, advice: str) -> None:
        """Say at the end of the message what the user can do; the first advice stands."""
        self.advice = self.advice or advice

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
        value = "" if first[0].value is None else f": {quoted(first[0].value)}"
        message = f"{self.count} {noun} in the {self.table}{more}; first: {first[0].where}: {first[0].why}{value}"
        raise kind(message + (f"; {self.advice}" if self.advice else ""), first)


def printable(text: str) -> str:
    """Return a text without characters that a terminal would act upon: these are escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def quoted(value: str) -> str:
    """Return a value as messages have it: cut, in quotes, with everything escaped that does not print."""
    return repr(value if len(value) <= SHOWN_IN_MESSAGE else f"{value[:SHOWN_IN_MESSAGE]}...")


def _row(fault: Fault) -> int:
    """Return the number of the row or line of a fault, 0 for one of the whole table."""
    number = re.match(r"(?:line|row) (\d+)", fault.where)
    return int(number[1]) if number else 0

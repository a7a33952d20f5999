"""Every fault of a table, collected and raised once."""

from __future__ import annotations

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

_GRAVEST_FIRST: Final[tuple[type[InputError], ...]] = (
    TelemetryFormatError,
    TimeZoneMissingError,
    TimeError,
    TelemetryValueError,
)


class FaultList:
    """Faults of one table: the first hundred are kept, all are counted."""

    def __init__(self, table: str) -> None:
        self.table = table
        self.count = 0
        self.first: list[Fault] = []
        self._kinds: set[type[InputError]] = set()

    def add(self, kind: type[InputError], where: str, why: str, value: object = None) -> None:
        """Note one fault; ``kind`` is the error that it alone would raise."""
        self.count += 1
        self._kinds.add(kind)
        if len(self.first) < FIRST_FAULTS:
            shown = None if value is None else str(value)[:SHOWN_VALUE]
            self.first.append(Fault(where, why, shown))

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
        first = self.first[0]
        raise kind(f"{self.count} {noun} in the {self.table}{more}; first: {first.where}: {first.why}", self.first)

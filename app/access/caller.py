"""Who calls: the scopes of a key and the satellites that it is bound to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Scope(StrEnum):
    """What a key may do; ``admin`` includes the others, which do not include each other."""

    READ = "read"
    INGEST = "ingest"
    OPERATE = "operate"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks: a key's id, its scopes and the satellites that it is bound to (None: all)."""

    key_id: str
    scopes: frozenset[str]
    satellites: frozenset[str] | None = None
    address: str | None = None
    request_id: str | None = None

    def may(self, *scopes: Scope) -> bool:
        """Return whether the key has one of ``scopes``."""
        return Scope.ADMIN in self.scopes or any(scope in self.scopes for scope in scopes)

    def reaches(self, satellite_id: str) -> bool:
        """Return whether the key may know of a satellite."""
        return self.satellites is None or satellite_id in self.satellites


SYSTEM: Final = Caller("system", frozenset({Scope.ADMIN}))
"""magcal itself: its workers and its command line."""

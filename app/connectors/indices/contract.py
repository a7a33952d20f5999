"""What a source of an index offers: files at addresses, each with the time after which it changes no more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from app.settings import Settings


@dataclass(frozen=True, slots=True)
class IndexPart:
    """One file of a source: its name among the source's, its address, and when it is final (None: never)."""

    name: str
    url: str
    final_at: datetime | None = None


class IndexSource(Protocol):
    """One source of one index."""

    index_name: str

    def parts(self, settings: Settings, since: datetime, now: datetime) -> Sequence[IndexPart]:
        """Return the files that cover ``since`` to ``now``, the oldest first."""
        ...

"""What a source of orbits offers: one answer a satellite."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from app.settings import Settings


@dataclass(frozen=True, slots=True)
class Watched:
    """An object whose orbit is kept fresh: its number, digits only, as catalogues take it, and the satellites it is."""

    catalogue_number: str
    satellite_ids: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Limit:
    """At most ``most`` requests within ``within_s``."""

    most: int
    within_s: float


@dataclass(frozen=True, slots=True)
class Reply:
    """What a source answered: an orbit message."""

    body: bytes
    media_type: str


class OrbitSource(Protocol):
    """One source: its limits beside that of each object, the package that it needs beside ours, how it is asked."""

    limits: tuple[Limit, ...]
    package: str | None

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return what the source has of an object; the errors are those of `app.connectors.errors`."""
        ...


@runtime_checkable
class PastSource(Protocol):
    """A source that also has the elements of the past."""

    def ask_between(self, settings: Settings, watched: Watched, first: date, last: date) -> Reply | None:
        """Return what the source has of an object from one day to another (not included), None where nothing."""
        ...

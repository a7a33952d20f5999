"""What a source of orbits offers: one answer a satellite."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Protocol, runtime_checkable

from app.settings import Settings


@dataclass(frozen=True, slots=True)
class Watched:
    """A satellite whose orbit is kept fresh, and what catalogues know it by."""

    satellite_id: str
    norad_id: str | None
    cospar_id: str | None


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
    """One source: its limits beside that of each satellite, and how it is asked."""

    limits: tuple[Limit, ...]

    def ask(self, settings: Settings, satellite: Watched) -> Reply:
        """Return what the source has of a satellite; the errors are those of `app.connectors.http`."""
        ...


@runtime_checkable
class PastSource(Protocol):
    """A source that also has the elements of the past."""

    def ask_between(self, settings: Settings, satellite: Watched, first: date, last: date) -> Reply | None:
        """Return what the source has of a satellite from one day to another (not included), None where nothing."""
        ...


def catalogue_number(satellite: Watched) -> str:
    """Return the satellite's catalogue number, digits only, as sources take it."""
    return (satellite.norad_id or "").lstrip("0") or "0"

"""Orbit messages -> orbits, each verified before it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np

from app.errors import UnsupportedMediaError
from magcal_core.orbit import Orbit
from magcal_core.orbit.sgp4 import Sgp4Orbit
from magcal_core.orbit.sources import OrbitSource, parse_orbits, parse_sources

MEDIA_TYPES: Final = frozenset(
    {"", "text/plain", "application/json", "application/xml", "text/xml", "text/csv", "application/octet-stream"}
)


@dataclass(frozen=True, slots=True)
class ParsedOrbit:
    """One orbit of a message, with the text that it can be read from again."""

    format: str
    name: str | None
    epoch: datetime
    until: datetime | None
    content: str
    details: dict[str, object]


def parse_message(body: bytes, media_type: str) -> list[ParsedOrbit]:
    """Return the orbits of a message; mean elements can be propagated at their epoch.

    Raises
    ------
    InputError, PropagationError
        The message is malformed, or its elements describe no orbit; the faults say where.
    UnsupportedMediaError
        The content type is not one of an orbit message.
    """
    plain = media_type.partition(";")[0].strip().lower()
    if plain not in MEDIA_TYPES:
        raise UnsupportedMediaError("this content type is not an orbit message")
    found = parse_sources(body, plain or None)
    for source in found:
        if isinstance(source.orbit, Sgp4Orbit):
            source.orbit.position_itrf_km(np.array([source.epoch_utc], "datetime64[ns]"))
    return [_parsed(source) for source in found]


def _parsed(source: OrbitSource) -> ParsedOrbit:
    details: dict[str, object] = {"norad_id": source.norad_id or None, "cospar_id": source.cospar_id or None}
    until = None if source.until_utc is None else instant(source.until_utc)
    return ParsedOrbit(source.kind, source.name or None, instant(source.epoch_utc), until, source.text, details)


def orbit_of(content: str) -> Orbit:
    """Return the orbit that is kept as ``content``."""
    return parse_orbits(content)[0]


def instant(t_utc: np.datetime64) -> datetime:
    """Return a time of the core, rounded down to microseconds."""
    microseconds = int(t_utc.astype("datetime64[us]").astype(np.int64))
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)

"""Orbit messages -> orbits, each verified before it is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np

from app.errors import UnsupportedMediaError
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.frames import teme_to_itrf
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
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
    _propagate([source.orbit for source in found if isinstance(source.orbit, Sgp4Orbit)])
    return [_parsed(source) for source in found]


def _propagate(orbits: Sequence[Sgp4Orbit]) -> None:
    """Raise where an orbit has no position at its epoch; all are rotated at once, as that takes most of the time."""
    epochs_utc = np.array([orbit.epoch_utc for orbit in orbits], "datetime64[ns]")
    r_teme_km = [orbit.state_teme(epochs_utc[i : i + 1])[0] for i, orbit in enumerate(orbits)]
    if orbits:
        teme_to_itrf(epochs_utc, np.concatenate(r_teme_km))


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

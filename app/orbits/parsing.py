"""Orbit messages -> orbits, each verified before it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from app.errors import UnsupportedMediaError
from magcal_core.errors import EncodingError
from magcal_core.orbit import Orbit
from magcal_core.orbit.sgp4 import Sgp4Orbit
from magcal_core.orbit.tle import Tle, parse_tles


@dataclass(frozen=True, slots=True)
class ParsedOrbit:
    """One orbit of a message, with the text that it can be read from again."""

    format: str
    name: str | None
    epoch: datetime
    content: str
    details: dict[str, object]
    valid_from: datetime | None = None
    valid_until: datetime | None = None


def parse_message(body: bytes, media_type: str) -> list[ParsedOrbit]:
    """Return the orbits of a message.

    Raises
    ------
    InputError
        The message is malformed; its faults say where.
    UnsupportedMediaError
        The content type is not one of an orbit message.
    """
    plain = media_type.partition(";")[0].strip().lower()
    if plain not in {"", "text/plain", "application/octet-stream"}:
        raise UnsupportedMediaError("this content type is not an orbit message")
    try:
        text = body.decode("utf-8")
    except UnicodeDecodeError as error:
        raise EncodingError(f"the text is not UTF-8: byte {error.start}") from None
    return [_of_tle(tle) for tle in parse_tles(text)]


def _of_tle(tle: Tle) -> ParsedOrbit:
    Sgp4Orbit(tle).position_itrf_km(np.array([tle.epoch_utc]))
    details = {
        "norad_id": tle.norad_id,
        "cospar_id": tle.cospar_id,
        "inclination_deg": tle.inclination_deg,
        "perigee_km": tle.perigee_km,
        "apogee_km": tle.apogee_km,
    }
    return ParsedOrbit("tle", tle.name or None, instant(tle.epoch_utc), tle.text, details)


def instant(t_utc: np.datetime64) -> datetime:
    """Return a time of the core, rounded down to microseconds."""
    microseconds = int(t_utc.astype("datetime64[us]").astype(np.int64))
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)


def orbit_of(form: str, content: str) -> Orbit:
    """Return the orbit that is kept as ``content`` in the format ``form``."""
    return Sgp4Orbit.from_tle(content)

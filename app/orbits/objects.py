"""Whether an orbit is of its satellite: by the NORAD and COSPAR ids that both have."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from app.errors import OtherObjectError
from app.orbits.parsing import ParsedOrbit
from app.satellites.tables import Satellite

MOST_NAMED: Final = 3
_NUMBER: Final = re.compile(r"\d{1,9}")
_COSPAR: Final = re.compile(r"(?:\d{2})?(\d{2})(?:-(\d{1,3})|(\d{3}))([A-Z]{1,3})")


def difference(satellite: Satellite, details: Mapping[str, object]) -> str | None:
    """Return which id of an orbit is not the satellite's, and what both are; None where none that both have differs.

    Messages of CCSDS have one `OBJECT_ID`: a designator, by custom a catalogue number, or a word such as ``UNKNOWN``,
    which is no id.
    """
    norad, cospar = (str(details.get(name) or "").strip() for name in ("norad_id", "cospar_id"))
    if _NUMBER.fullmatch(cospar):
        norad, cospar = norad or cospar, ""
    pairs = (
        ("NORAD", norad, satellite.norad_id or "", _norad),
        ("COSPAR", cospar, satellite.cospar_id or "", _cospar),
    )
    for name, sent, own, plain in pairs:
        if plain(sent) and plain(own) and plain(sent) != plain(own):
            return f"{name} id {sent[:20]}, the satellite's is {own}"
    return None


def _norad(text: str) -> str:
    plain = text.strip()
    return plain.lstrip("0") or plain[-1:]


def _cospar(text: str) -> str:
    """Return a designator without its form, ``2020-068H``, ``20068H`` and ``2020-68H`` are one; "" where it is none."""
    match = _COSPAR.fullmatch(text.strip().upper())
    return "" if match is None else f"{match[1]}{int(match[2] or match[3]):03d}{match[4]}"


def check_objects(satellite: Satellite, orbits: Sequence[ParsedOrbit]) -> None:
    """Raise OtherObjectError where an orbit is of another object than the satellite."""
    found = [
        f"orbit {number} of {len(orbits)}, epoch {orbit.epoch:%Y-%m-%dT%H:%M:%S}Z: {other}"
        for number, orbit in enumerate(orbits, 1)
        if (other := difference(satellite, orbit.details)) is not None
    ]
    if found:
        more = f", and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else ""
        raise OtherObjectError(f"of another object: {'; '.join(found[:MOST_NAMED])}{more}; force=true keeps them")

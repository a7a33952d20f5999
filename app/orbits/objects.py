"""Whether an orbit is of its satellite: by the NORAD and COSPAR ids that both have."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from app.errors import OtherObjectError
from app.orbits.parsing import ParsedOrbit
from app.satellites.tables import Satellite

MOST_NAMED: Final = 3
_COSPAR: Final = re.compile(r"(?:\d{2})?(\d{2})(?:-(\d{1,3})|(\d{3}))([A-Z]{1,3})")


def difference(satellite: Satellite, details: Mapping[str, object]) -> str | None:
    """Return which id of an orbit is not the satellite's, and what both are; None where none that both have differs."""
    pairs = (
        ("NORAD", details.get("norad_id"), satellite.norad_id, _norad),
        ("COSPAR", details.get("cospar_id"), satellite.cospar_id, _cospar),
    )
    for name, sent, own, plain in pairs:
        if sent and own and plain(str(sent)) != plain(own):
            return f"{name} id {str(sent)[:20]}, the satellite's is {own}"
    return None


def _norad(text: str) -> str:
    return text.strip().lstrip("0") or "0"


def _cospar(text: str) -> str:
    """Return a designator without its form: ``2020-068H``, ``20068H`` and ``2020-68H`` are one."""
    match = _COSPAR.fullmatch(text.strip().upper())
    return text.strip().upper() if match is None else f"{match[1]}{int(match[2] or match[3]):03d}{match[4]}"


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

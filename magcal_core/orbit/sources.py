"""Orbits from whatever they are written in: TLE, OMM, OEM, state vector; the form is found from the content."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from magcal_core.errors import EncodingError, Fault, OrbitFormatError
from magcal_core.orbit import Orbit
from magcal_core.orbit.messages.oem import parse_oem
from magcal_core.orbit.messages.omm import Omm, parse_omms
from magcal_core.orbit.messages.state import StateVector, parse_state, state_from_mapping
from magcal_core.orbit.messages.tle import Tle, parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

Kind = Literal["tle", "omm", "oem", "state"]

MAX_BYTES: Final = 64 * 2**20
"""Longest text that is read, bytes."""

_FORMS_OF_TYPE: Final[Mapping[str, tuple[str, ...]]] = {
    "application/json": ("json",),
    "application/xml": ("xml",),
    "text/xml": ("xml",),
    "text/csv": ("csv",),
    "text/plain": ("tle", "omm-kvn", "oem-kvn", "csv"),
}
"""Media type -> the forms that it may hold; other types hold any."""


@dataclass(frozen=True, slots=True, eq=False)
class OrbitSource:
    """One orbit as it can be kept: its text, which `parse_sources` reads again, and what the text says.

    Attributes
    ----------
    kind : str
        ``tle``, ``omm``, ``oem`` or ``state``.
    text : str
        The TLE, the OMM as JSON, the OEM as it came, the state vector as JSON.
    name, norad_id, cospar_id : str
        "" where the source does not have them.
    epoch_utc, until_utc : datetime64
        Epoch, or start of an ephemeris, and its end (None for the others), UTC.
    orbit : Orbit
        What computes positions; a state vector is integrated with EGM96 12x12, Sun and Moon.
    """

    kind: Kind
    text: str
    name: str
    norad_id: str
    cospar_id: str
    epoch_utc: np.datetime64
    until_utc: np.datetime64 | None
    orbit: Orbit


def parse_orbits(content: bytes | str, media_type: str | None = None) -> list[Orbit]:
    """Return the orbits in ``content``, as `parse_sources` reads them."""
    return [source.orbit for source in parse_sources(content, media_type)]


def parse_sources(content: bytes | str, media_type: str | None = None) -> list[OrbitSource]:
    """Return every orbit in ``content``: TLEs, OMMs (JSON, XML, CSV, KVN), an OEM (KVN, XML), or state vectors (JSON).

    Raises
    ------
    TleFormatError, TleChecksumError
        A TLE is wrong.
    OrbitFormatError
        Another form is wrong, the text is too long, or the media type promises another form.
    EncodingError
        The text is not UTF-8.
    PropagationError
        SGP4 refuses the elements.
    """
    if len(content) > MAX_BYTES:
        raise OrbitFormatError(f"the orbit text has {len(content)} bytes; at most {MAX_BYTES}")
    text = content if isinstance(content, str) else _decoded(content)
    form = _form(text)
    declared = (media_type or "").partition(";")[0].strip().lower()
    if form not in _FORMS_OF_TYPE.get(declared, (form,)):
        raise OrbitFormatError(f"the content is declared as {declared}, but it is {form}")
    return _READERS[form](text)


def _decoded(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise EncodingError(f"the orbit text is not UTF-8 at byte {error.start}") from error


def _form(text: str) -> str:
    start = text.lstrip("\ufeff \t\r\n")[:200]
    first_line = start.partition("\n")[0]
    if start.startswith(("{", "[")):
        return "json"
    if start.startswith("<"):
        return "xml"
    if "CCSDS_OEM_VERS" in start:
        return "oem-kvn"
    if "CCSDS_OMM_VERS" in start:
        return "omm-kvn"
    return "csv" if "," in first_line and "OBJECT_" in first_line else "tle"


def _of_json(text: str) -> list[OrbitSource]:
    try:
        content = json.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        raise OrbitFormatError("the orbit is not JSON", [Fault("orbit", str(error)[:200])]) from error
    rows = content if isinstance(content, list) else [content]
    if rows and all(isinstance(row, dict) and "position_km" in row for row in rows):
        return [_of_state(state_from_mapping(row)) for row in rows]
    if rows and all(isinstance(row, dict) and "MEAN_MOTION" in row for row in rows):
        return [_of_mean_elements("omm", omm) for omm in parse_omms(text.removeprefix("\ufeff"), "json")]
    if isinstance(content, dict):
        return [_of_state(parse_state(text.removeprefix("\ufeff")))]
    raise OrbitFormatError("JSON of an orbit is an OMM, a state vector, or a list of one of them")


def _of_xml(text: str) -> list[OrbitSource]:
    if "<oem" in text[:4000].lower():
        return _of_oem(text)
    return [_of_mean_elements("omm", omm) for omm in parse_omms(text, "xml")]


def _of_oem(text: str) -> list[OrbitSource]:
    orbit = parse_oem(text)
    return [OrbitSource("oem", text, orbit.name, "", orbit.cospar_id, orbit.epoch_utc, orbit.until_utc, orbit)]


def _of_state(state: StateVector) -> OrbitSource:
    from magcal_core.orbit.propagators.numerical import NumericalOrbit

    orbit = NumericalOrbit.from_state(state.epoch_utc, state.r_km, state.v_km_s, state.frame)
    return OrbitSource("state", state.text, "", "", "", state.epoch_utc, None, orbit)


def _of_mean_elements(kind: Kind, elements: Tle | Omm) -> OrbitSource:
    names = (elements.name, elements.norad_id, elements.cospar_id)
    return OrbitSource(kind, elements.text, *names, elements.epoch_utc, None, Sgp4Orbit(elements))


_READERS: Final[Mapping[str, Callable[[str], list[OrbitSource]]]] = {
    "json": _of_json,
    "xml": _of_xml,
    "csv": lambda text: [_of_mean_elements("omm", omm) for omm in parse_omms(text, "csv")],
    "tle": lambda text: [_of_mean_elements("tle", tle) for tle in parse_tles(text)],
    "omm-kvn": lambda text: [_of_mean_elements("omm", omm) for omm in parse_omms(text, "kvn")],
    "oem-kvn": _of_oem,
}

"""Orbits from whatever they are written in: TLE, OMM, OEM, state vector; the form is found from the content.

What reads a form is loaded when a text has it.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from magcal_core.errors import EncodingError, Fault, OrbitFormatError, TleFormatError
from magcal_core.orbit import Orbit
from magcal_core.orbit.messages.bulletin import tles_alone
from magcal_core.orbit.messages.forms import form_of, refuse_binary, refuse_json_message, without_comments
from magcal_core.orbit.messages.json_tle import mean_elements, tle_text
from magcal_core.orbit.messages.tle import Tle, parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

if TYPE_CHECKING:
    from magcal_core.orbit.messages.omm import Omm
    from magcal_core.orbit.messages.state import StateVector

Kind = Literal["tle", "omm", "oem", "state"]

MAX_BYTES: Final = 64 * 2**20
"""Longest text that is read, bytes."""

_GZIP: Final = b"\x1f\x8b"
_FORMS_OF_TYPE: Final[Mapping[str, tuple[str, ...]]] = {
    "application/json": ("json",),
    "application/xml": ("xml",),
    "text/xml": ("xml",),
    "text/csv": ("csv",),
    "text/plain": ("tle", "omm-kvn", "oem-kvn", "opm-kvn", "sp3", "stk", "csv"),
}
"""Media type -> the forms that it may hold; other types hold any."""


_PROSE: Final = (
    "neither a line of a TLE",
    "control character",
    "name has ",
    "line 1 of a TLE, but",
    "line 2 of a TLE, but",
)
"""What `parse_tles` finds in text that stands around TLEs."""


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
    """Return every orbit in ``content``.

    TLEs (alone, inside JSON or with text around them), OMMs (JSON, XML, CSV, KVN), an OEM or OPMs (KVN, XML), SP3-c or
    -d, an STK ephemeris, or state vectors (JSON); `magcal_core.orbit.messages.forms` tells them apart.

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
    form = form_of(text)
    declared = (media_type or "").partition(";")[0].strip().lower()
    if form not in _FORMS_OF_TYPE.get(declared, (form,)):
        raise OrbitFormatError(f"the content is declared as {declared}, but it is {form}")
    return _READERS[form](text)


def _decoded(content: bytes) -> str:
    if content.startswith(_GZIP):
        content = _unpacked(content)
    refuse_binary(content)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise EncodingError(f"the orbit text is not UTF-8 at byte {error.start}") from error


def _unpacked(content: bytes) -> bytes:
    """Return what a gzip file holds, as archives of orbits keep their files."""
    unpacker = zlib.decompressobj(wbits=31)
    try:
        text = unpacker.decompress(content, MAX_BYTES + 1)
    except zlib.error as error:
        raise OrbitFormatError("the orbit is gzip, but damaged") from error
    if len(text) > MAX_BYTES:
        raise OrbitFormatError(f"the orbit text has more than {MAX_BYTES} bytes, unpacked")
    if not unpacker.eof:
        raise OrbitFormatError("the orbit is gzip, but cut")
    return text


def _of_json(text: str) -> list[OrbitSource]:
    try:
        content = json.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        raise OrbitFormatError("the orbit is not JSON", [Fault("orbit", str(error)[:200])]) from error
    refuse_json_message(content)
    rows = content if isinstance(content, list) else [content]
    from magcal_core.orbit.messages.state import parse_state, state_from_mapping

    if rows and all(isinstance(row, dict) and "position_km" in row for row in rows):
        return [_of_state(state_from_mapping(row)) for row in rows]
    if records := mean_elements(content):
        return _of_omms(json.dumps(records), "json")
    if tles := tle_text(content):
        return _of_tle(tles)
    if isinstance(content, dict):
        return [_of_state(parse_state(text.removeprefix("\ufeff")))]
    raise OrbitFormatError("JSON of an orbit is an OMM, a TLE, a state vector, or a list of one of them")


def _of_xml(text: str) -> list[OrbitSource]:
    if "<oem" in text[:4000].lower():
        return _of_oem(text)
    if "<opm" in text[:4000].lower():
        return _of_opm(text)
    return _of_omms(text, "xml")


def _of_tle(text: str) -> list[OrbitSource]:
    try:
        tles = parse_tles(text)
    except TleFormatError as error:
        # Only prose is passed over: a line of a TLE that is wrong stays a fault of the text.
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        if wrong := [fault for fault in error.faults if not _is_prose(fault, lines)]:
            more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
            raise type(error)(f"TLE {wrong[0].where}: {wrong[0].why}{more}", error.faults) from error
        alone = tles_alone(text)
        if not alone:
            raise
        tles = parse_tles(alone)
    return [_of_mean_elements("tle", tle) for tle in tles]


def _is_prose(fault: Fault, lines: Sequence[str]) -> bool:
    """Return whether a fault is of a line that is no line of a TLE at all."""
    place = re.match(r"line (\d+)", fault.where)
    line = lines[int(place[1]) - 1] if place else ""
    return fault.why.startswith(_PROSE) and re.match(r"\s*[12] +\w{5}[UCS ]? ", line) is None


def _of_omms(text: str, form: str) -> list[OrbitSource]:
    from magcal_core.orbit.messages.omm import parse_omms

    return [_of_mean_elements("omm", omm) for omm in parse_omms(text, form)]


def _of_csv(text: str) -> list[OrbitSource]:
    return _of_omms(without_comments(text), "csv")


def _of_kvn(text: str) -> list[OrbitSource]:
    return _of_omms(text, "kvn")


def _of_sp3(text: str) -> list[OrbitSource]:
    from magcal_core.orbit.messages.sp3 import parse_sp3

    return _of_oem(parse_sp3(without_comments(text)))


def _of_stk(text: str) -> list[OrbitSource]:
    from magcal_core.orbit.messages.stk import parse_stk

    return _of_oem(parse_stk(text))


def _of_opm(text: str) -> list[OrbitSource]:
    from magcal_core.orbit.messages.opm import parse_opms

    return [replace(_of_state(state), name=name, cospar_id=cospar_id) for state, name, cospar_id in parse_opms(text)]


def _of_oem(text: str) -> list[OrbitSource]:
    from magcal_core.orbit.ephemeris.oem import parse_oem

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
    "csv": _of_csv,
    "tle": _of_tle,
    "omm-kvn": _of_kvn,
    "oem-kvn": _of_oem,
    "opm-kvn": _of_opm,
    "sp3": _of_sp3,
    "stk": _of_stk,
}

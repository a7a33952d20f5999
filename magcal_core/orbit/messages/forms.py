"""The forms that orbit text may have, one line a form: what is read, and what is recognised and named as not read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from magcal_core.errors import Fault, OrbitFormatError
from magcal_core.foreign_files import HTML, binary_file, page_words
from magcal_core.orbit.messages.bulletin import has_tle

MOST_OF_A_MESSAGE: Final = 80
"""Characters of a server's message that an error repeats."""
_SHORT: Final = 2000
"""Longest text that may be a server's message rather than a damaged orbit, characters."""


@dataclass(frozen=True, slots=True)
class Form:
    """One form.

    Attributes
    ----------
    name : as `FORMS` and the media types know it.
    words : what people call it.
    begins : whether a text is of the form, by its first characters without blanks.
    is_read : whether there is a reader.
    """

    name: str
    words: str
    begins: Callable[[str], bool]
    is_read: bool = True


_COMMENTS: Final = re.compile(r"(?:#(?![a-z][PV ]\d{4}|#)[^\n]*\n\s*)+")
"""Lines of comment that some producers begin a file with; SP3 has its first lines behind ``#``, too."""


def _starts(pattern: str) -> Callable[[str], bool]:
    found = re.compile(pattern, re.IGNORECASE)
    return lambda start: found.match(start) is not None


def _has(*marks: str) -> Callable[[str], bool]:
    found = re.compile("|".join(marks), re.IGNORECASE)
    return lambda start: found.search(start) is not None


def _xml_of(root: str) -> Callable[[str], bool]:
    inside = re.compile(rf"<(?:\w+:)?{root}[\s>]", re.IGNORECASE)
    return lambda start: start.startswith("<") and inside.search(start) is not None


def _is_csv_of_elements(start: str) -> bool:
    names = {name.strip(" \"'\r").upper() for name in re.split("[,;\t]", start.partition("\n")[0])}
    return {"MEAN_MOTION", "ECCENTRICITY"} <= names


FORMS: Final = (
    Form("html", "an HTML page", _starts(HTML), is_read=False),
    Form("json", "JSON", _starts(r"[{\[]")),
    Form("csv", "CSV of mean elements", _is_csv_of_elements),
    Form("kml", "a KML file", _xml_of("kml"), is_read=False),
    Form("gpx", "a GPX file", _xml_of("gpx"), is_read=False),
    Form("aem-xml", "an attitude message (CCSDS AEM or APM)", _xml_of("a[ep]m"), is_read=False),
    Form("cdm-xml", "a conjunction message (CCSDS CDM)", _xml_of("cdm"), is_read=False),
    Form("tdm-xml", "a tracking message (CCSDS TDM)", _xml_of("tdm"), is_read=False),
    Form("ocm-xml", "an orbit comprehensive message (CCSDS OCM)", _xml_of("ocm"), is_read=False),
    Form("eof", "an orbit file of an Earth Explorer (EOF)", _xml_of("Earth_Explorer_File"), is_read=False),
    Form("xml", "XML", _starts("<")),
    Form("oem-kvn", "an OEM", _has("CCSDS_OEM_VERS")),
    Form("omm-kvn", "an OMM", _has("CCSDS_OMM_VERS")),
    Form("opm-kvn", "an OPM", _has("CCSDS_OPM_VERS")),
    Form("aem-kvn", "an attitude message (CCSDS AEM or APM)", _has("CCSDS_AEM_VERS", "CCSDS_APM_VERS"), is_read=False),
    Form("cdm-kvn", "a conjunction message (CCSDS CDM)", _has("CCSDS_CDM_VERS"), is_read=False),
    Form("tdm-kvn", "a tracking message (CCSDS TDM)", _has("CCSDS_TDM_VERS"), is_read=False),
    Form("ocm-kvn", "an orbit comprehensive message (CCSDS OCM)", _has("CCSDS_OCM_VERS"), is_read=False),
    Form("sp3", "an SP3 file", _starts(r"#[a-z][PV ]\d{4}[ \d]")),
    Form("stk", "an STK file", _starts(r"stk\.v\.")),
    Form("cpf", "a prediction for laser ranging (CPF)", _starts(r"H1\s+CPF"), is_read=False),
    Form("rinex", "a RINEX file", lambda start: "RINEX VERSION" in start.partition("\n")[0], is_read=False),
    Form("gmat", "a GMAT script", _starts(r"%?.*\n?Create Spacecraft"), is_read=False),
    Form("ndm-csv", "a table of positions", _starts(r"\"?(?:time|epoch|date)[^\n,;]*[,;][^\n]*\bx\b"), is_read=False),
)
"""Looked through in this order; what none of them is, is taken for TLEs, alone or with text around them."""

READ: Final = "TLE, OMM, OPM, OEM, SP3-c and -d, STK ephemeris (.e), state vector"
"""What is read, as messages have it."""
_ERROR_KEYS: Final = ("error", "errors", "detail", "message", "exception", "fault")
_SERVER: Final = re.compile(
    r"\b(error|forbidden|unauthori[sz]ed|not found|no (gp )?data|denied|too many requests|rate limit|bad gateway|login|"
    r"log in|logged in|unavailable|timed? ?out|invalid query|blocked|violation)\b|^[45]\d\d\b",
    re.IGNORECASE,
)


def refuse_binary(content: bytes) -> None:
    """Raise where bytes begin like a file that is no text.

    Raises
    ------
    OrbitFormatError
        They do; the message names the file.
    """
    words = binary_file(content)
    if words is not None:
        raise OrbitFormatError(f"this is {words}; orbits are read from text: {READ}")


def form_of(text: str) -> str:
    """Return the name of the form of a text, ``tle`` for TLEs.

    Raises
    ------
    OrbitFormatError
        The text is of a form that is not read, an HTML page, or what a server answers where it has no orbit.
    """
    start = without_comments(text)[:4000]
    form = next((one for one in FORMS if one.begins(start)), None)
    if form is None:
        if not has_tle(text):
            _refuse_message(start, len(text))
        return "tle"
    if form.name == "html":
        raise OrbitFormatError(
            f"this is {page_words(start)}, not an orbit: a page for people, or a server's error or login"
        )
    if not form.is_read:
        raise OrbitFormatError(f"this is {form.words}, which is not read; read are {READ}")
    return form.name


def without_comments(text: str) -> str:
    """Return a text without a byte order mark, and without blank lines and lines behind ``#`` that it begins with."""
    text = text.lstrip("\ufeff \t\r\n")
    found = _COMMENTS.match(text)
    return text if found is None else text[found.end() :]


def _refuse_message(start: str, length: int) -> None:
    """Raise where a text without any TLE reads like what a server says instead of an orbit."""
    line = start.strip().partition("\n")[0]
    if length <= _SHORT and not re.match(r"[12] +\d", line) and _SERVER.search(line):
        raise OrbitFormatError(f"this is a server's message, not an orbit: {_quoted(line)}")


def refuse_json_message(content: object) -> None:
    """Raise where a JSON value is what a server says instead of an orbit.

    Raises
    ------
    OrbitFormatError
        It is; the message has what it says.
    """
    one = content[0] if isinstance(content, list) and len(content) == 1 else content
    if not isinstance(one, dict):
        return
    said = next((one[key] for key in one if str(key).lower() in _ERROR_KEYS and one[key]), None)
    if said is not None:
        text = said if isinstance(said, str) else json.dumps(said)
        raise OrbitFormatError(
            f"this is a server's message, not an orbit: {_quoted(text)}", [Fault("orbit", "no orbit")]
        )


def _quoted(text: str) -> str:
    """Return a text cut, on one line, in quotes, with everything escaped that does not print."""
    plain = " ".join(text.split())
    return repr(plain if len(plain) <= MOST_OF_A_MESSAGE else f"{plain[:MOST_OF_A_MESSAGE]}...")

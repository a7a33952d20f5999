"""Keyword = value text of CCSDS, and XML with the same keywords."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from magcal_core.errors import Fault, OrbitFormatError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


@dataclass(frozen=True, slots=True)
class KvnLine:
    """One line of a message: a keyword with its value, or, with an empty keyword, a line of data."""

    number: int
    keyword: str
    value: str


def kvn_lines(text: str) -> Iterator[KvnLine]:
    """Yield the lines of a message but for blank ones and comments; a unit in brackets is taken off the value.

    Keywords may be in any case, and comments may stand behind ``#``, too, as some producers write them.
    """
    for number, raw in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("#") or line.split(maxsplit=1)[0].upper() == "COMMENT":
            continue
        keyword, equals, value = line.partition("=")
        if not equals:
            yield KvnLine(number, "", line.upper() if "_" in line else line)
        else:
            value = value.strip()
            if value.endswith("]"):
                value = value[: value.rfind("[")].strip()
            yield KvnLine(number, keyword.strip().upper(), value)


_FORTRAN: Final = re.compile(r"([\d.])[dD]([+-]?\d)")


def number(text: str) -> float:
    """Return a number of a message; the exponent may be Fortran's, ``1.5D+03``.

    Raises
    ------
    ValueError
        The text is no number; ``1_000`` and digits of other scripts, which Python reads, are none.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{text[:40]!r} is not a number")
    return float(_FORTRAN.sub(r"\1e\2", text))


def parse_xml(text: str) -> Element:
    """Return the root of an XML message; entities and document types are refused.

    Raises
    ------
    OrbitFormatError
        The text is not XML, or has a document type or entities.
    """
    from xml.etree.ElementTree import ParseError

    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    try:
        root: Element = fromstring(text, forbid_dtd=True)
    except ParseError as error:
        raise OrbitFormatError("the orbit message is not XML", [Fault("XML", str(error))]) from error
    except (DefusedXmlException, ValueError) as error:
        why = "a document type, an entity or an encoding that is not accepted"
        raise OrbitFormatError(f"the orbit message has {why}", [Fault("XML", why)]) from error
    return root


def tag(element: Element) -> str:
    """Return the tag of an element without its namespace."""
    return element.tag.rpartition("}")[2]


def find_all(root: Element, name: str) -> list[Element]:
    """Return the elements of that name at any depth, ``root`` included, in document order."""
    return [element for element in root.iter() if tag(element) == name]


def leaves(element: Element) -> dict[str, str]:
    """Return the texts of the elements below that have no elements themselves, by tag."""
    return {tag(leaf): (leaf.text or "").strip() for leaf in element.iter() if not len(leaf) and leaf is not element}

"""TLEs and OMMs inside JSON, as SatNOGS, N2YO and others send them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from magcal_core.orbit.messages.bulletin import has_tle

_LINES: Final = (
    ("tle0", "tle1", "tle2"),
    ("tle_line0", "tle_line1", "tle_line2"),
    ("tle_0", "tle_1", "tle_2"),
    ("line0", "line1", "line2"),
    ("name", "line1", "line2"),
)
"""Keys of name and lines, without regard to case."""
_NAMES: Final = ("name", "satname", "object_name", "satellite_name")
_MOST_LEVELS: Final = 8


def mean_elements(content: object, level: int = 0) -> list[object]:
    """Return the OMMs in a JSON value, at any depth, as servers wrap them; keys in any case.

    What stands beside an OMM in a list is one, too, whatever it lacks: `parse_omms` says what.
    """
    if _is_omm(content):
        return [content]
    if level > _MOST_LEVELS or not isinstance(content, list | dict):
        return []
    inside = list(content.values()) if isinstance(content, dict) else content
    if isinstance(content, list) and any(map(_is_omm, content)):
        return content
    return [found for one in inside for found in mean_elements(one, level + 1)]


def _is_omm(content: object) -> bool:
    return isinstance(content, dict) and any(str(key).upper() == "MEAN_MOTION" for key in content)


def tle_text(content: object) -> str:
    """Return the TLEs in a JSON value as text, in their order, "" where there is none."""
    return "".join(_found(content, 0))


def _found(content: object, level: int) -> Iterator[str]:
    if level > _MOST_LEVELS:
        return
    if isinstance(content, list):
        if content and all(isinstance(one, str) for one in content):
            yield "".join(f"{one.strip()}\n" for one in content) if has_tle("\n".join(content)) else ""
            return
        for one in content:
            yield from _found(one, level + 1)
    elif isinstance(content, dict):
        own = {str(key).lower(): value for key, value in content.items()}
        lines = _lines(own)
        if lines:
            yield lines
            return
        for value in own.values():
            yield from _found(value, level + 1)


def _lines(own: dict[str, object]) -> str:
    for name, first, second in _LINES:
        one, two = own.get(first), own.get(second)
        if isinstance(one, str) and isinstance(two, str):
            return _joined(own.get(name), own, one, two)
    whole = own.get("tle")
    if isinstance(whole, list) and 2 <= len(whole) <= 3 and all(isinstance(line, str) for line in whole):
        whole = "\n".join(whole)
    if isinstance(whole, str):
        lines = [line for line in whole.splitlines() if line.strip()]
        if len(lines) in (2, 3) and lines[-2].startswith("1 ") and lines[-1].startswith("2 "):
            return _joined(lines[0] if len(lines) == 3 else None, own, *lines[-2:])
    return ""


def _joined(name: object, own: dict[str, object], one: str, two: str) -> str:
    known = [name, *(own.get(key) for key in _NAMES)]
    first = next((text.strip() for text in known if isinstance(text, str) and text.strip()), "")
    above = f"{' '.join(first.split())}\n" if first else ""
    return f"{above}{one.strip()}\n{two.strip()}\n"

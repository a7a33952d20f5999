"""TLEs with text around them: mails, bulletins, pages saved as text."""

from __future__ import annotations

import re
from typing import Final

_QUOTING: Final = "> \t|"
_LINE: Final = {kind: re.compile(rf"{kind} [ \dA-Z]\d{{4}}[ UCS\d].{{52,}}") for kind in "12"}
_NAME: Final = re.compile(r"(?:0 )?[\w][\w .()\[\]/+&'#*-]{0,39}")
_MOST_WORDS: Final = 5


def has_tle(text: str) -> bool:
    """Return whether a line of the text is the first of a TLE and the next but blank ones the second."""
    return bool(_pairs(_stripped(text)))


def tles_alone(text: str) -> str:
    """Return the TLEs of a text without what stands around them, each with its name where the line above is one."""
    lines = _stripped(text)
    kept: list[str] = []
    for first, second in _pairs(lines):
        above = lines[first - 1] if first else ""
        if _NAME.fullmatch(above) and len(above.split()) <= _MOST_WORDS and not _is_element_line(above):
            kept.append(above)
        kept += [lines[first], lines[second]]
    return "\n".join(kept) + "\n" if kept else ""


def _stripped(text: str) -> list[str]:
    lines = (line.lstrip(_QUOTING).rstrip() for line in text.removeprefix("\ufeff").splitlines())
    return [line for line in lines if line]


def _is_element_line(line: str) -> bool:
    return any(pattern.match(line) for pattern in _LINE.values())


def _pairs(lines: list[str]) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(len(lines) - 1) if _LINE["1"].match(lines[i]) and _LINE["2"].match(lines[i + 1])]

"""Wrap the lines of the documentation at 110 columns: `python docs/wrap_lines.py`; a test looks for longer ones.

Paragraphs and items of lists are wrapped again where one of their lines is longer. Code, tables, headings and lines
that are one link stay as they are; what stands between backticks is not broken.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
COLUMNS: Final = 110
FENCE: Final = re.compile(r"\s*(```|~~~)")
ITEM: Final = re.compile(r"(\s*)([-*+]|\d+[.)])\s+")
FIXED: Final = re.compile(r"\s*(\||#|>|<|!!!|\?\?\?|\[[^\]]+\]:|={3,}|-{3,}\s*$)")
LINK: Final = re.compile(r"\s*(?:[-*+]\s+)?!?\[[^\]]*\]\([^)]*\)[.,;:]?\s*$")
_BLANK: Final = "\x00"


def pages() -> list[Path]:
    """Return the pages: those in docs, and those of the repository's top that people read."""
    top = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")]
    return [*top, *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(text: str) -> Iterator[tuple[bool, list[str]]]:
    """Yield runs of lines, and whether each is a paragraph or an item of a list, which may be wrapped."""
    run: list[str] = []
    in_fence, in_code, in_item = False, False, False
    for line in text.split("\n"):
        if in_fence or FENCE.match(line):
            if run:
                yield True, run
                run = []
            if FENCE.match(line):
                in_fence = not in_fence
            yield False, [line]
            continue
        item = ITEM.match(line)
        if not run:
            # Four blanks begin code, but where they go on with an item.
            in_code = line.startswith("    ") and not in_item and not item
        if in_code or not line.strip() or FIXED.match(line) or LINK.match(line):
            if run:
                yield True, run
                run = []
            in_item = in_item and (not line.strip() or line.startswith(" "))
            yield False, [line]
            continue
        if item and run:
            yield True, run
            run = []
        in_item = (in_item and line.startswith(" ")) or item is not None
        run.append(line)
    if run:
        yield True, run


def wrapped(text: str) -> str:
    """Return a page with its long paragraphs wrapped."""
    lines: list[str] = []
    for is_free, run in blocks(text):
        is_long = any(len(line) > COLUMNS for line in run)
        is_broken = any(line.endswith(("  ", "\\")) for line in run)
        lines += _wrap(run) if is_free and is_long and not is_broken else run
    return "\n".join(lines)


def long_lines(text: str) -> list[str]:
    """Return the lines of paragraphs and items that are too long."""
    found = [line for is_free, run in blocks(text) if is_free for line in run if len(line) > COLUMNS]
    # A line of one word, such as a command between backticks, cannot be broken.
    return [line for line in found if len(_words(line)) > 1]


def _wrap(run: list[str]) -> list[str]:
    item = ITEM.match(run[0])
    first = item[0] if item else re.match(r"\s*", run[0])[0]  # type: ignore[index]
    later = " " * len(first)
    text = " ".join([run[0][len(first) :], *(line.strip() for line in run[1:])])
    found = textwrap.wrap(
        " ".join(_words(text)),
        COLUMNS,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(_BLANK, " ") for line in found]


def _words(text: str) -> list[str]:
    """Return what may be on lines of its own: blanks in code are none, nor those before what would begin an item."""
    whole = re.sub(r"(`+)(?!`).+?(?<!`)\1(?!`)", lambda code: code[0].replace(" ", _BLANK), text)
    bound = re.sub(r" +(?=(?:[-+*>|=]|#+|\d+[.)])(?: |$))", _BLANK, whole)
    return bound.split()


if __name__ == "__main__":
    for path in pages():
        text = path.read_text(encoding="utf-8")
        if wrapped(text) != text:
            path.write_text(wrapped(text), encoding="utf-8")

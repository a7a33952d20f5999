"""Draw what each field source leaves of CHAOS-7's magnetosphere, from the table of `field.md`.

`python docs/draw_external_field.py` draws the table; a test draws it anew and compares. With `--measure`, and
`MAGCAL_CHAOS` the path of `CHAOS-7.mat`, it measures and writes the table first.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from math import log10
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from benchmarks.magnetosphere import Spread

DOCS: Final = Path(__file__).resolve().parent
PAGE: Final = DOCS / "field.md"
IMAGE: Final = "field-left-over.svg"
BEGIN: Final = "<!-- what is left of CHAOS-7's magnetosphere: python docs/draw_external_field.py --measure -->"
END: Final = "<!-- end of what is left -->"
GROUPS: Final = ("all", "10 deg", "28 deg", "52 deg", "70 deg", "98 deg", "storms")
DRAWN: Final = {"igrf-14": "#9a3b26", "igrf-14+mean": "#c9a227", "igrf-14+rc": "#20639b"}
"""Field source -> its colour."""
WIDTH, PANEL, LEFT, TOP, GAP = 820, 210, 64, 44, 62
BAR, SPACE = 29, 3


def table(left: Mapping[str, Mapping[str, Spread]]) -> Iterator[str]:
    """Yield the lines of the table: |B| / component, nT / common scale error, ppm."""
    yield f"| field | {' | '.join(GROUPS)} |"
    yield "| --- " * (1 + len(GROUPS)) + "|"
    for field, groups in left.items():
        cells = (groups[name] for name in GROUPS)
        texts = (f"{one.size_nt:.1f} / {one.component_nt:.1f} / {one.scale_ppm:.0f}" for one in cells)
        name, comma, rest = field.partition(",")
        yield f"| `{name}`{comma}{rest} | {' | '.join(texts)} |"


def write_table(left: Mapping[str, Mapping[str, Spread]]) -> None:
    """Put the table between its marks in the page."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text("\n".join([before + BEGIN, "", *table(left), "", END]) + after, encoding="utf-8")


def read_table() -> dict[str, list[tuple[float, float]]]:
    """Return field source -> |B|, nT, and common scale error, ppm, of each group."""
    _, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    text, _, _ = rest.partition(END)
    found = {}
    for row in text.splitlines():
        cells = [cell.strip() for cell in row.strip().strip("|").split("|")]
        if re.fullmatch(r"`[^`]+`", cells[0]):
            triples = [tuple(map(float, cell.split("/"))) for cell in cells[1:]]
            found[cells[0].strip("`")] = [(size, ppm) for size, _, ppm in triples]
    return found


def drawing(left: Mapping[str, Sequence[tuple[float, float]]]) -> str:
    """Return two panels as SVG, |B| that is left above the common scale error, on a logarithmic axis each."""
    height = TOP + 2 * PANEL + GAP + 30
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" '
        'font-size="12" role="img" aria-label="What each field source leaves of the magnetosphere of CHAOS-7: of the '
        'size of the field, and of the common scale factor of a session">',
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
    ]
    for i, (field, colour) in enumerate(DRAWN.items()):
        parts.append(_rect(LEFT + 150 * i, 14, 14, 14, colour))
        parts.append(_text(LEFT + 150 * i + 20, 26, field, "start"))
    parts += _panel(left, 0, (1.0, 200.0), TOP, "|B| that is left, nT rms")
    parts += _panel(left, 1, (10.0, 5000.0), TOP + PANEL + GAP, "common scale error, ppm rms")
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(
    left: Mapping[str, Sequence[tuple[float, float]]],
    figure: int,
    span: tuple[float, float],
    top: float,
    title: str,
) -> Iterator[str]:
    low, high = span

    def height(value: float) -> float:
        return PANEL * log10(value / low) / log10(high / low)

    for mark in (1, 10, 100, 1000):
        if low <= mark <= high:
            y = top + PANEL - height(mark)
            yield f'<line x1="{LEFT}" x2="{WIDTH - 12}" y1="{y:.1f}" y2="{y:.1f}" stroke="#dddddd"/>'
            yield _text(LEFT - 8, y + 4, str(mark), "end")
    for place, group in enumerate(GROUPS):
        x = LEFT + 12 + place * (3 * (BAR + SPACE) + 10)
        for column, (field, colour) in enumerate(DRAWN.items()):
            value = left[field][place][figure]
            at, tall = x + column * (BAR + SPACE), height(value)
            yield _rect(at, top + PANEL - tall, BAR, tall, colour)
            yield _text(at + BAR / 2, top + PANEL - tall - 4, f"{value:g}")
        yield _text(x + 1.5 * (BAR + SPACE), top + PANEL + 18, group)
    yield f'<text transform="translate(16 {top + PANEL / 2:.1f}) rotate(-90)" text-anchor="middle">{title}</text>'


def _rect(x: float, y: float, width: float, height: float, colour: str) -> str:
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:g}" height="{height:.1f}" fill="{colour}"/>'


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="#222222">{text}</text>'


def drawings() -> dict[str, str]:
    """Return file name -> drawing."""
    return {IMAGE: drawing(read_table())}


if __name__ == "__main__":
    if "--measure" in sys.argv[1:]:
        from benchmarks.magnetosphere import spreads

        write_table(spreads())
    for name, drawn in drawings().items():
        (DOCS / "images" / name).write_text(drawn, encoding="utf-8")

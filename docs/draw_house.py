"""Draw the rooms of the code and the way of a sample from the imports: `python docs/draw_house.py`.

The layers are those that import-linter holds (`pyproject.toml`); arrows are imports that the code has today, so that
the drawing cannot grow old: a test draws it anew and compares.
"""

from __future__ import annotations

import tomllib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

import grimp

ROOT: Final = Path(__file__).resolve().parent.parent
IMAGES: Final = ROOT / "docs" / "images"
CONTRACTS: Final = {
    "magcal_core": "the core's rooms, top to bottom",
    "app": "the service's rooms, top to bottom",
}
STATIONS: Final = (
    ("bytes", None, "a file, a request, a folder"),
    ("telemetry reader", "magcal_core.telemetry", "rows, columns, units, flags"),
    ("Samples", "magcal_core.samples", "time order, nT, base frame"),
    ("reference", "magcal_core.reference", "orbit by time, position, field"),
    ("observations", "magcal_core.observations", "what an estimator sees"),
    ("estimation", "magcal_core.estimation", "clock, regressors, estimator"),
    ("uncertainty", "magcal_core.calibration.uncertainty", "honest errors, cross-validation"),
    ("verdict", "magcal_core.calibration.verdict", "accept, weak, refuse, and why"),
    ("Calibration", "magcal_core.calibration.result", "the record"),
)
"""The way of a sample: station, the module where it is, what happens there; `magcal calibrate` leads through them."""

BOX_W, BOX_H, GAP_X, GAP_Y, MARGIN = 150, 34, 18, 26, 20
FONT: Final = 'font-family="sans-serif" font-size="13"'


def layers_of(root: str) -> list[list[str]]:
    """Return the layers that import-linter holds in ``root``, top to bottom, each the names of its rooms."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    layers = next(one["layers"] for one in contracts if one["name"] == CONTRACTS[root])
    return [[room.strip() for room in layer.split("|")] for layer in layers]


def arrows_of(graph: grimp.ImportGraph, rooms: Iterable[str]) -> dict[str, set[str]]:
    """Return room -> the rooms that it imports."""
    names = sorted(rooms, key=len, reverse=True)

    def room_of(module: str) -> str | None:
        return next((room for room in names if module == room or module.startswith(f"{room}.")), None)

    found: dict[str, set[str]] = defaultdict(set)
    for module in graph.modules:
        for imported in graph.find_modules_directly_imported_by(module):
            pair = room_of(module), room_of(imported)
            if pair[0] and pair[1] and pair[0] != pair[1]:
                found[pair[0]].add(pair[1])
    return found


def without_detours(arrows: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the arrows that no longer way replaces: what a room reaches stays the same."""

    def reached(room: str) -> set[str]:
        return set(arrows[room]).union(*(reached(one) for one in arrows[room]))

    return {
        room: {one for one in near if not any(one in reached(other) for other in near)} for room, near in arrows.items()
    }


def house(graph: grimp.ImportGraph, root: str) -> str:
    """Return the drawing of the rooms of ``root`` as SVG: a row a layer, an arrow where a room imports a lower one
    and no longer way leads there.
    """
    layers = layers_of(root)
    width = max(len(row) for row in layers) * (BOX_W + GAP_X) + 2 * MARGIN + 2 * BOX_W
    height = len(layers) * (BOX_H + GAP_Y) + 2 * MARGIN
    place = {
        room: (
            (width - len(row) * (BOX_W + GAP_X) + GAP_X) / 2 + i * (BOX_W + GAP_X),
            MARGIN + level * (BOX_H + GAP_Y),
        )
        for level, row in enumerate(layers)
        for i, room in enumerate(row)
    }
    arrows = arrows_of(graph, place)
    direct = without_detours(defaultdict(set, {room: arrows[room] for room in place}))
    drawn = [
        _arrow(place[a], place[b], i) for i, a in enumerate(place) for b in sorted(direct[a], key=list(place).index)
    ]
    boxes = [_box(x, y, room.removeprefix(f"{root}."), _title(room, arrows[room])) for room, (x, y) in place.items()]
    return _svg(width, height, [*drawn, *boxes])


def way(graph: grimp.ImportGraph) -> str:
    """Return the drawing of the way of a sample as SVG; every station is one that `magcal calibrate` reaches."""
    reached = graph.find_upstream_modules("app.cli.calibrate")
    wide = 2 * BOX_W
    parts = []
    for i, (name, module, what) in enumerate(STATIONS):
        if module is not None and not any(one == module or one.startswith(f"{module}.") for one in reached):
            raise ValueError(f"magcal calibrate does not reach {module}")
        y = MARGIN + i * (BOX_H + GAP_Y)
        if i:
            parts.append(_arrow((MARGIN, y - BOX_H - GAP_Y), (MARGIN, y), 0, wide))
        parts.append(_box(MARGIN, y, f"{name}: {what}", module or "", wide))
    return _svg(wide + 2 * MARGIN, len(STATIONS) * (BOX_H + GAP_Y) + 2 * MARGIN, parts)


def _title(room: str, imports: set[str]) -> str:
    return f"{room} imports {', '.join(sorted(imports)) or 'no other room'}"


def _box(x: float, y: float, text: str, title: str, width: float = BOX_W) -> str:
    return (
        f'<g><title>{escape(title)}</title><rect x="{x:g}" y="{y:g}" width="{width:g}" height="{BOX_H}" rx="5" '
        f'fill="#fff" stroke="#345" stroke-width="1.5"/><text x="{x + width / 2:g}" y="{y + BOX_H / 2 + 5:g}" '
        f'text-anchor="middle" {FONT} fill="#123">{escape(text)}</text></g>'
    )


def _arrow(start: tuple[float, float], end: tuple[float, float], shade: int, width: float = BOX_W) -> str:
    x0, y0, x1, y1 = start[0] + width / 2, start[1] + BOX_H, end[0] + width / 2, end[1]
    third = (y1 - y0) / 3
    bend = 0.0 if y1 - y0 <= GAP_Y else (18 + 11 * (shade % 7)) * (1 if shade % 2 else -1) * (y1 - y0) / 200
    colour = ("#8ab", "#b98", "#9a7", "#a8b")[shade % 4]
    return (
        f'<path d="M{x0:g} {y0:g} C{x0 + bend:g} {y0 + third:g} {x1 + bend:g} {y1 - third:g} {x1:g} {y1:g}" '
        f'fill="none" stroke="{colour}" stroke-width="1" marker-end="url(#tip)"/>'
    )


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    tip = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#789"/></marker></defs>'
    )
    body = "\n".join(parts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img">\n'
        f'<rect width="100%" height="100%" fill="#f7f9fb"/>\n{tip}\n{body}\n</svg>\n'
    )


def drawings() -> dict[str, str]:
    """Return file name -> drawing."""
    graph = grimp.build_graph("magcal_core", "app", cache_dir=None)
    return {
        "house-core.svg": house(graph, "magcal_core"),
        "house-service.svg": house(graph, "app"),
        "way-of-a-sample.svg": way(graph),
    }


if __name__ == "__main__":
    for name, drawing in drawings().items():
        (IMAGES / name).write_text(drawing, encoding="utf-8")

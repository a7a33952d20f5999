"""The latest figures as tables in ``docs/performance-figures.md``, between its two marks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from benchmarks.record import read_latest

PAGE: Final = Path(__file__).parent.parent / "docs" / "performance-figures.md"
BEGIN: Final = "<!-- figures: written by `python -m benchmarks --write-docs` -->"
END: Final = "<!-- end of the figures -->"
BUSY: Final = 0.5
"""Processes for each core that wanted a processor, beyond which the machine counts as busy."""
STATES: Final = {True: "met", False: "**missed**", None: ""}


def write_page() -> None:
    """Write the latest figures into the page."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text("\n".join([before + BEGIN, "", *_lines(read_latest()), END]) + after)


def _lines(record: Mapping[str, object]) -> Iterator[str]:
    machine, versions, rooms = (_mapping(record.get(name)) for name in ("machine", "versions", "rooms"))
    yield f"{machine.get('processor')}, {machine.get('cores')} cores, {machine.get('system')}."
    yield ", ".join(f"{name} {number}" for name, number in versions.items()) + "."
    yield ""
    for name in sorted(rooms):
        room = _mapping(rooms[name])
        load, cores = room.get("load"), machine.get("cores")
        is_busy = isinstance(load, float | int) and isinstance(cores, int) and load > BUSY * cores
        busy = f" **The machine was busy (load {load}): compare ratios, not times.**" if is_busy else ""
        yield f"### {name}"
        yield ""
        yield f"`python -m benchmarks {name}`, {room.get('at')}, {room.get('took_s')} s.{busy}"
        yield ""
        yield "| what | figure | aim | | |"
        yield "| --- | --- | --- | --- | --- |"
        found = room.get("figures")
        for figure in found if isinstance(found, list) else []:
            yield _row(_mapping(figure))
        yield ""


def _row(figure: Mapping[str, object]) -> str:
    value, is_met = figure["value"], figure["is_met"]
    number = f"{value:.4g}" if isinstance(value, float | int) else str(value)
    state = STATES[is_met] if isinstance(is_met, bool) else ""
    cells = (figure["what"], f"{number} {figure['unit']}".strip(), figure["aim"], state, figure["note"])
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}

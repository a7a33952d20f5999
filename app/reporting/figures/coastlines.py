"""Coastlines for maps: Natural Earth 1:110 million, version 4.1.0, in the public domain (naturalearthdata.com).

The points that change no line by more than 0.25 degrees are left out, the rest is rounded to tenths of a degree.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import resources

from app.reporting.figures.style import Theme, Trace, scatter


@cache
def coastline_degrees() -> tuple[list[float | None], list[float | None]]:
    """Return longitude and latitude, deg, of all coastlines; None stands between one line and the next."""
    text = (resources.files("app.reporting.figures") / "coastlines.json").read_text(encoding="ascii")
    longitude: list[float | None] = []
    latitude: list[float | None] = []
    for line in json.loads(text):
        longitude += [*(tenths / 10 for tenths in line[::2]), None]
        latitude += [*(tenths / 10 for tenths in line[1::2]), None]
    return longitude, latitude


def coastlines(theme: Theme) -> Trace:
    """Return the coastlines over longitude and latitude in degrees."""
    return scatter(*coastline_degrees(), "lines", line={"color": theme.muted, "width": 1}, hoverinfo="skip")

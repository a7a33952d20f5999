"""Lines of equal field strength, by which a map of residuals shows whether they follow the field."""

from __future__ import annotations

from typing import Final

import numpy as np

from app.reporting.figures.style import Theme, Trace
from magcal_core.arrays import Floats, Times

STEP_DEG: Final = 5.0
STEP_NT: Final = 5000.0
DEGREE: Final = 8
"""Degree of the model: at a satellite's height higher terms do not move a line by its own width."""
YEARS: Final = (np.datetime64("1900-01-01"), np.datetime64("2030-01-01"))


def field_lines(t_utc: Times, r_itrf_km: Floats, theme: Theme) -> list[Trace]:
    """Return the lines of equal |B| at the median height of positions, shape (n, 3), km; none outside IGRF's years."""
    from magcal_core.field.igrf import Igrf

    when = t_utc[len(t_utc) // 2 : len(t_utc) // 2 + 1]
    if when.size == 0 or not YEARS[0] <= when[0] < YEARS[1]:
        return []
    longitude_deg = np.arange(-180.0, 180.0 + STEP_DEG, STEP_DEG)
    latitude_deg = np.arange(-87.5, 90.0, STEP_DEG)
    radius_km = float(np.median(np.linalg.norm(r_itrf_km, axis=1)))
    lat, lon = (np.deg2rad(grid) for grid in np.meshgrid(latitude_deg, longitude_deg, indexing="ij"))
    r_km = radius_km * np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    b_nt = Igrf(max_degree=DEGREE).field_itrf_nt(np.repeat(when, lat.size), r_km.reshape(-1, 3))
    lines: Trace = {
        "type": "contour",
        "x": longitude_deg,
        "y": latitude_deg,
        "z": np.round(np.linalg.norm(b_nt, axis=1).reshape(lat.shape)),
        "contours": {"coloring": "none", "start": 15000.0, "end": 70000.0, "size": STEP_NT, "showlabels": True,
                     "labelfont": {"size": 9, "color": theme.muted}},
        "line": {"color": theme.grid, "width": 1.5},
        "showscale": False,
        "hoverinfo": "skip",
    }  # fmt: skip
    return [lines]

"""Which of a satellite's orbits serves a time: an ephemeris that covers it, else the nearest epoch."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from app.orbits.tables import OrbitRow


def chosen(rows: Sequence[OrbitRow], at: datetime) -> OrbitRow | None:
    """Return the orbit that a calibration at ``at`` would use, None where there is none."""
    covering = [row for row in rows if _covers(row, at)]
    return covering[-1] if covering else min(rows, key=lambda row: abs(row.epoch - at), default=None)


def _covers(row: OrbitRow, at: datetime) -> bool:
    return row.until is not None and row.epoch <= at <= row.until

"""Times, sessions and calls as the causes' sentences and buttons have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Final

from app.attention.causes.contract import Action
from app.attention.situation import Situation

INSTANT: Final = timedelta(microseconds=1)
"""The least that one time differs from another."""


def age(since: datetime, now: datetime) -> str:
    """Return how long ago ``since`` was, in hours up to two days, then in days."""
    elapsed = now - since
    if elapsed < timedelta(days=2):
        return f"{elapsed / timedelta(hours=1):.1f} h"
    return f"{elapsed / timedelta(days=1):.1f} days"


def age_unchanged_for(since: datetime, now: datetime) -> timedelta:
    """Return for how long from ``now`` on `age` says the same, at least.

    What is said changes where a tenth is rounded up; which side an instant there is on is left to `age`.
    """
    elapsed = now - since
    is_hours = elapsed < timedelta(days=2)
    tenth = timedelta(minutes=6) if is_hours else timedelta(hours=2.4)
    half = tenth / 2
    next_change = ((elapsed + half - INSTANT) // tenth + 1) * tenth - half
    if is_hours:
        next_change = min(next_change, timedelta(days=2))
    return max(next_change - elapsed - INSTANT, INSTANT)


def satellite_page(situation: Situation, part: str = "") -> str:
    """Return the address of the satellite's page, or of a part of it."""
    return f"/satellites/{situation.satellite_id}{part}"


def calibrate(situation: Situation, session_ids: Sequence[str], label: str = "Calibrate") -> Action:
    """Return the button that calibrates ``session_ids`` as the magnetometer's policy, or the set in force, does."""
    policy = dict(situation.policy or {})
    options: Mapping[str, object] = {
        name: value for name, value in policy.items() if name not in {"calibrate", "priority"}
    }
    if not options and situation.active is not None:
        options = {"method": situation.active.method}
    body = {"kind": "calibration", **options, "session_ids": list(session_ids)}
    return Action(label, "POST", "/api/v1/jobs", body)


def activate(parameter_set_id: str) -> Action:
    """Return the button that puts a set in force."""
    return Action("Activate", "POST", f"/api/v1/parameter-sets/{parameter_set_id}/activate", {})

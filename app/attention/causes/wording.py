"""Times, sessions and calls as the causes' sentences and buttons have them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta

from app.attention.causes.contract import Action
from app.attention.situation import Situation


def age(since: datetime, now: datetime) -> str:
    """Return how long ago ``since`` was, in hours up to two days, then in days."""
    elapsed = now - since
    if elapsed < timedelta(days=2):
        return f"{elapsed / timedelta(hours=1):.1f} h"
    return f"{elapsed / timedelta(days=1):.1f} days"


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

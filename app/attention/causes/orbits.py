"""The orbit that a calibration needs is not there, or is another object's."""

from __future__ import annotations

from datetime import datetime

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import satellite_page
from app.attention.situation import Situation


class OrbitMissing:
    """There is no orbit, and the telemetry has neither position nor reference field."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that an orbit is missing; the button goes to where one is given."""
        session = situation.session
        if situation.orbit is not None or session is None or not session.needs_orbit:
            return None
        text = "There is no orbit, and the telemetry has neither position nor reference field"
        action = Action("Add orbit", "GET", satellite_page(situation, "#orbits"))
        return Finding(Severity.ACT, text, session.created_at, session.id, {"session_id": session.id}, action)


class OrbitOtherObject:
    """The newest orbit names another object than the satellite is."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return which object it is of; the button goes to the orbits, where one is withdrawn or another given."""
        orbit, own = situation.orbit, situation.norad_id
        if orbit is None or own is None or orbit.norad_id is None or _plain(orbit.norad_id) == _plain(own):
            return None
        kind = {"tle": "TLE", "omm": "OMM", "oem": "OEM"}.get(orbit.format, "The orbit")
        text = f"{kind} is of NORAD {orbit.norad_id}, the satellite is {own}"
        action = Action("Choose orbit", "GET", satellite_page(situation, "#orbits"))
        return Finding(Severity.ACT, text, orbit.created_at, orbit.id, {"orbit_id": orbit.id}, action)


def _plain(norad_id: str) -> str:
    """Return a catalogue number without what it may be padded with: 00900 is 900."""
    return norad_id.strip().lstrip("0")

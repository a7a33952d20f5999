"""The orbit that a calibration needs is not there, or is another object's."""

from __future__ import annotations

from datetime import datetime

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import satellite_page
from app.attention.situation import Situation, is_other_object
from app.http.schemas import day_text


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
        """Return which object it is of.

        The button takes it out of use where the satellite has an orbit of its own; else it goes to the orbits, where
        another is given or the satellite's number is corrected.
        """
        orbit, own = situation.orbit, situation.norad_id
        if orbit is None or not is_other_object(own, orbit.norad_id):
            return None
        kind = {"tle": "TLE", "omm": "OMM", "oem": "OEM"}.get(orbit.format, "The orbit")
        text = f"{kind} is of NORAD {orbit.norad_id}, the satellite is {own}"
        action = Action("Choose orbit", "GET", satellite_page(situation, "#orbits"))
        if orbit.instead is not None:
            withdraw = f"/api/v1/satellites/{situation.satellite_id}/orbits/{orbit.id}/withdraw"
            action = Action(f"Use the own orbit of {day_text(orbit.instead.epoch)}", "POST", withdraw, {})
        return Finding(Severity.ACT, text, orbit.created_at, orbit.id, {"orbit_id": orbit.id}, action)

"""What is too old: readings, orbit, the last word of the station. Limits are the satellite's own."""

from __future__ import annotations

from datetime import datetime, timedelta

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import age, satellite_page
from app.attention.situation import Situation
from app.http.schemas import day_text


class DataStale:
    """The newest reading is too old."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it is, since the limit was passed; the button goes to where telemetry is sent."""
        session, limit = situation.session, timedelta(days=situation.data_stale_days)
        if session is None or now - session.data_until <= limit:
            return None
        text = (
            f"The newest reading is of {day_text(session.data_until)}, {age(session.data_until, now)} old; "
            f"limit {situation.data_stale_days:g} days"
        )
        action = Action("Send telemetry", "GET", satellite_page(situation, "#upload-telemetry"))
        links = {"session_id": session.id}
        return Finding(Severity.WATCH, text, session.data_until + limit, session.id, links, action)


class OrbitStale:
    """The newest orbit is too old."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it is, since the limit was passed; the button goes to the orbits."""
        orbit, limit = situation.orbit, timedelta(days=situation.orbit_stale_days)
        if orbit is None:
            return None
        serves_until = orbit.until or orbit.epoch
        if now - serves_until <= limit:
            return None
        what = "ends on" if orbit.until is not None else "has its epoch on"
        text = (
            f"The newest orbit {what} {day_text(serves_until)}, {age(serves_until, now)} ago; "
            f"limit {situation.orbit_stale_days:g} days"
        )
        action = Action("Add orbit", "GET", satellite_page(situation, "#orbits"))
        return Finding(Severity.WATCH, text, serves_until + limit, orbit.id, {"orbit_id": orbit.id}, action)


class StationSilent:
    """Nothing has arrived for too long."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that the station is silent, since the limit was passed; before the first session it is not."""
        received, limit = situation.received_at, timedelta(hours=situation.station_silent_hours)
        if received is None or now - received <= limit:
            return None
        text = f"Nothing has arrived for {age(received, now)}; limit {situation.station_silent_hours:g} h"
        action = Action("Show sessions", "GET", satellite_page(situation, "#sessions"))
        return Finding(Severity.WATCH, text, received + limit, received.isoformat(), {}, action)

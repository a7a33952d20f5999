"""What is too old: readings, orbit, the last word of the station. Limits are the satellite's own."""

from __future__ import annotations

from datetime import datetime, timedelta

from app.attention.causes.contract import Action, Finding, Severity
from app.attention.causes.wording import INSTANT, age, age_unchanged_for, satellite_page
from app.attention.situation import Situation
from app.http.schemas import day_text


class DataStale:
    """The newest reading is too old."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it is, since the limit was passed; the button goes to where telemetry is sent."""
        session, limit = situation.session, _days(situation.data_stale_days)
        if session is None or now - session.data_until <= limit:
            return None
        text = (
            f"The newest reading is of {day_text(session.data_until)}, {age(session.data_until, now)} old; "
            f"limit {situation.data_stale_days:g} days"
        )
        action = Action("Send telemetry", "GET", satellite_page(situation, "#upload-telemetry"))
        links = {"session_id": session.id}
        return Finding(Severity.WATCH, text, session.data_until + limit, session.id, links, action)

    def unchanged_for(self, situation: Situation, now: datetime) -> timedelta | None:
        """Return for how long the reading stays within its limit, or its age is said the same way."""
        session = situation.session
        return _unchanged_for(None if session is None else session.data_until, _days(situation.data_stale_days), now)


class OrbitStale:
    """The newest orbit is too old."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return that it is, since the limit was passed; the button goes to the orbits."""
        orbit, limit = situation.orbit, _days(situation.orbit_stale_days)
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

    def unchanged_for(self, situation: Situation, now: datetime) -> timedelta | None:
        """Return for how long the orbit stays within its limit, or its age is said the same way."""
        orbit = situation.orbit
        return _unchanged_for(
            None if orbit is None else orbit.until or orbit.epoch, _days(situation.orbit_stale_days), now
        )


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

    def unchanged_for(self, situation: Situation, now: datetime) -> timedelta | None:
        """Return for how long the silence stays within its limit, or is said the same way."""
        return _unchanged_for(situation.received_at, timedelta(hours=situation.station_silent_hours), now)


def _days(count: float) -> timedelta:
    return timedelta(days=count)


def _unchanged_for(since: datetime | None, limit: timedelta, now: datetime) -> timedelta | None:
    """Return for how long what began at ``since`` stays within ``limit``, or past it, for how long its age is the same.

    An age of exactly the limit is within it, and the next instant is not.
    """
    if since is None:
        return None
    left = limit - (now - since)
    return max(left, INSTANT) if left >= timedelta(0) else age_unchanged_for(since, now)

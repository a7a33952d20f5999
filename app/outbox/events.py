"""The things that happen, as values: what `app.outbox.log.append` writes and readers of the log are handed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from app.http.schemas import utc_text


class EventType(StrEnum):
    """The names of what happens; a contract."""

    SESSION_RECEIVED = "session.received"
    JOB_ENDED = "job.ended"
    PARAMETER_SET_CREATED = "parameter_set.created"
    PARAMETER_SET_ACTIVATED = "parameter_set.activated"
    ATTENTION_RAISED = "attention.raised"
    ATTENTION_CLEARED = "attention.cleared"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened: to which satellite and magnetometer, and what there is to say of it.

    An event of no satellite is seen by keys that are bound to none, and by ``owner``, the key that asked for it.
    """

    type: EventType
    data: Mapping[str, object]
    satellite_id: str | None = None
    magnetometer_id: str | None = None
    owner: str | None = None


@dataclass(frozen=True, slots=True)
class Entry:
    """An event in the log: its place in the order of all, its id, and when it happened."""

    position: int
    event_id: str
    at: datetime
    event: Event

    @property
    def body(self) -> dict[str, object]:
        """What is told of it: type, timestamp, data."""
        return {"type": str(self.event.type), "timestamp": utc_text(self.at), "data": dict(self.event.data)}

    @property
    def lane(self) -> str:
        """Within which of a magnetometer's events the order is kept; events of none share one of their own."""
        return f"{self.event.satellite_id or ''}/{self.event.magnetometer_id or ''}"


def session_received(
    *,
    session_id: str,
    satellite_id: str,
    magnetometer_id: str,
    samples: int,
    data_from: datetime | None,
    data_until: datetime | None,
) -> Event:
    """Return that a session's telemetry is there, whole: it was uploaded in one piece, or closed."""
    data = {
        "session_id": session_id,
        "satellite": satellite_id,
        "magnetometer": magnetometer_id,
        "samples": samples,
        "data_from": None if data_from is None else utc_text(data_from),
        "data_until": None if data_until is None else utc_text(data_until),
    }
    return Event(EventType.SESSION_RECEIVED, data, satellite_id, magnetometer_id)


def job_ended(
    *,
    job_id: str,
    kind: str,
    state: str,
    satellite_id: str | None,
    magnetometer_id: str | None,
    result: Mapping[str, object] | None,
    error: Mapping[str, object] | None,
    parent_id: str | None,
    owner: str | None,
) -> Event:
    """Return that a job has ended: succeeded, failed or cancelled."""
    data = {
        "job_id": job_id,
        "kind": kind,
        "state": state,
        "satellite": satellite_id,
        "magnetometer": magnetometer_id,
        "parent_id": parent_id,
        "result": None if result is None else dict(result),
        "error": None if error is None else {name: error.get(name) for name in ("code", "detail")},
    }
    return Event(EventType.JOB_ENDED, data, satellite_id, magnetometer_id, owner)


def parameter_set_created(
    *, parameter_set_id: str, satellite_id: str, magnetometer_id: str, job_id: str | None, grade: str, method: str
) -> Event:
    """Return that a calibration has left a parameter set."""
    data = {
        "parameter_set_id": parameter_set_id,
        "satellite": satellite_id,
        "magnetometer": magnetometer_id,
        "job_id": job_id,
        "verdict": grade,
        "method": method,
    }
    return Event(EventType.PARAMETER_SET_CREATED, data, satellite_id, magnetometer_id)


def parameter_set_activated(
    *, parameter_set_id: str | None, previous_id: str | None, satellite_id: str, magnetometer_id: str, by: str
) -> Event:
    """Return which parameter set is in force from now on, None for none, and which one was so before."""
    data = {
        "parameter_set_id": parameter_set_id,
        "previous_parameter_set_id": previous_id,
        "satellite": satellite_id,
        "magnetometer": magnetometer_id,
        "by": by,
    }
    return Event(EventType.PARAMETER_SET_ACTIVATED, data, satellite_id, magnetometer_id)


def attention_changed(
    *,
    is_raised: bool,
    cause: str,
    reason: str,
    satellite_id: str | None = None,
    magnetometer_id: str | None = None,
    details: Mapping[str, object] | None = None,
) -> Event:
    """Return that something wants a person's attention, or does so no longer.

    ``cause`` names it, at most 150 characters: the same while it lasts, so that people are told of it once.
    """
    data = {
        **(details or {}),
        "cause": cause,
        "reason": reason,
        "satellite": satellite_id,
        "magnetometer": magnetometer_id,
    }
    kind = EventType.ATTENTION_RAISED if is_raised else EventType.ATTENTION_CLEARED
    return Event(kind, data, satellite_id, magnetometer_id)

"""What a cause of attention is: a name, and whether a magnetometer's situation has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Protocol, runtime_checkable

from app.attention.situation import Situation


class Severity(StrEnum):
    """Whether somebody has to do something, or to keep an eye on it."""

    ACT = "act"
    WATCH = "watch"


@dataclass(frozen=True, slots=True)
class Action:
    """What mends it: a call of the API, or with GET a page to go to."""

    label: str
    method: str
    path: str
    body: Mapping[str, object] | None = None


@dataclass(frozen=True, slots=True)
class Finding:
    """That a magnetometer has a cause.

    ``about`` names the matter (a session, a job, a set): an acknowledgement holds as long as it stays the same.
    """

    severity: Severity
    text: str
    since: datetime
    about: str
    links: Mapping[str, str] = field(default_factory=dict)
    action: Action | None = None


class Cause(Protocol):
    """One cause of attention; its code is the name that the registry has it under."""

    def find(self, situation: Situation, now: datetime) -> Finding | None:
        """Return what there is of the cause at ``now``, None where there is nothing."""
        ...


@runtime_checkable
class TimedCause(Cause, Protocol):
    """A cause whose finding changes by the clock alone; any other finds the same at any time in the same situation."""

    def unchanged_for(self, situation: Situation, now: datetime) -> timedelta | None:
        """Return for how long from ``now`` on it finds the same, at least; None: for ever."""
        ...

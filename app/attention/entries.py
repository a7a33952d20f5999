"""The entries of what needs attention, found in a fleet's situation; one snapshot serves everybody for a moment."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.attention.causes.contract import Finding
from app.attention.causes.registry import CAUSES
from app.attention.situation import Situation, newest_change, situations
from app.storage.database import utc_now

TRUSTED_S: Final = 5.0
"""A snapshot serves so long at most, for time passes even where nothing is written."""
ORDER: Final = {code: number for number, code in enumerate(CAUSES)}


@dataclass(frozen=True, slots=True)
class Entry:
    """One magnetometer and cause."""

    id: str
    satellite_id: str
    magnetometer_id: str
    code: str
    finding: Finding

    @property
    def rank(self) -> tuple[int, int, float, str]:
        """Its place in the list, the worst first, of equal ones the newest."""
        is_watch = int(self.finding.severity == "watch")
        return is_watch, ORDER[self.code], -self.finding.since.timestamp(), self.id


@dataclass(frozen=True, slots=True)
class Standing:
    """A magnetometer's situation and what of it needs attention."""

    situation: Situation
    entries: Sequence[Entry]


def entry_id(satellite_id: str, magnetometer_id: str, code: str) -> str:
    """Return what names a magnetometer's cause, the same for ever: 32 hexadecimal digits."""
    return hashlib.sha256(f"{satellite_id}/{magnetometer_id}/{code}".encode()).hexdigest()[:32]


def standing(situation: Situation, now: datetime) -> Standing:
    """Return what of a situation needs attention at ``now``."""
    where = situation.satellite_id, situation.magnetometer_id
    found = ((code, cause.find(situation, now)) for code, cause in CAUSES.items())
    return Standing(
        situation, [Entry(entry_id(*where, code), *where, code, one) for code, one in found if one is not None]
    )


@dataclass(frozen=True, slots=True)
class _Snapshot:
    change: tuple[object, ...]
    made_s: float
    standings: Sequence[Standing]


class Fleet:
    """What is known of every magnetometer, asked of the database once a change of it."""

    def __init__(self) -> None:
        self._snapshot: _Snapshot | None = None
        self._lock = threading.Lock()

    def standings(self, session: Session, caller: Caller) -> Sequence[Standing]:
        """Return the standing of every magnetometer that the caller reaches."""
        found = self._current(session)
        if caller.satellites is None:
            return found
        return [one for one in found if one.situation.satellite_id in caller.satellites]

    def _current(self, session: Session) -> Sequence[Standing]:
        change = newest_change(session)
        with self._lock:
            known = self._snapshot
            if known is None or known.change != change or time.monotonic() - known.made_s > TRUSTED_S:
                now = utc_now()
                made = [standing(one, now) for one in situations(session)]
                known = self._snapshot = _Snapshot(change, time.monotonic(), made)
            return known.standings

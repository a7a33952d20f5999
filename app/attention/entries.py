"""The entries of what needs attention, found in a fleet's situation; one snapshot serves everybody for a moment."""

from __future__ import annotations

import hashlib
import threading
import time
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.attention.causes.contract import Finding
from app.attention.causes.registry import CAUSES
from app.attention.situation import Change, Situation, changed_satellites, newest_change, situations
from app.storage.database import utc_now

TRUSTED_S: Final = 5.0
"""A snapshot serves so long at most, for time passes even where nothing is written."""
AT_ONCE: Final = 150
"""Satellites that are asked for anew beside what is known of the others; of more, the whole fleet is."""
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


@lru_cache(maxsize=100_000)
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
    change: Change
    made_s: float
    standings: Mapping[tuple[str, str], Standing]


class Fleet:
    """What is known of every magnetometer; after a change only the satellites that it is of are asked for anew."""

    def __init__(self) -> None:
        self._snapshot: _Snapshot | None = None
        self._lock = threading.Lock()
        self._turn = ""
        self._noted: set[str] = set()

    def look_again(self, satellite_id: str) -> None:
        """Note that a satellite is to be asked for anew, for what was written of it is in no log."""
        with self._lock:
            self._noted.add(satellite_id)

    def standings(self, session: Session, caller: Caller) -> Sequence[Standing]:
        """Return the standing of every magnetometer that the caller reaches, by satellite and magnetometer."""
        found = self._current(session)
        if caller.satellites is None:
            return found
        return [one for one in found if one.situation.satellite_id in caller.satellites]

    def _current(self, session: Session) -> Sequence[Standing]:
        change = newest_change(session)
        with self._lock:
            known = self._snapshot
            is_old = known is None or time.monotonic() - known.made_s > TRUSTED_S
            if known is None or is_old or self._noted or known.change != change:
                known = self._snapshot = self._renewed(session, known, change, is_old=is_old)
            return list(known.standings.values())

    def _renewed(self, session: Session, known: _Snapshot | None, change: Change, *, is_old: bool) -> _Snapshot:
        """Return the snapshot of now: what changed since ``known`` asked for anew, of an old one all judged anew."""
        now, now_s = utc_now(), time.monotonic()
        noted, self._noted = self._noted, set()
        changed = None if known is None else changed_satellites(session, known.change)
        if known is None or changed is None or len(changed) > AT_ONCE:
            return _Snapshot(change, now_s, _by_place(standing(one, now) for one in situations(session)))
        changed |= noted
        if is_old:
            # Not every write is of a change that is told: all satellites are asked for in turns.
            changed |= self._in_turn(known)
        kept = {place: one for place, one in known.standings.items() if place[0] not in changed}
        if is_old:
            kept = {place: standing(one.situation, now) for place, one in kept.items()}
        new = [standing(one, now) for one in situations(session, sorted(changed))] if changed else []
        made_s = now_s if is_old else known.made_s
        return _Snapshot(change, made_s, _by_place([*kept.values(), *new]))

    def _in_turn(self, known: _Snapshot) -> set[str]:
        """Return the satellites whose turn it is, a part of a large fleet, all of a small one."""
        every = sorted({satellite_id for satellite_id, _ in known.standings})
        begin = bisect_right(every, self._turn)
        turn = [*every[begin:], *every[:begin]][:AT_ONCE]
        self._turn = turn[-1] if turn else ""
        return set(turn)


def _by_place(standings: Iterable[Standing]) -> dict[tuple[str, str], Standing]:
    found = {(one.situation.satellite_id, one.situation.magnetometer_id): one for one in standings}
    return dict(sorted(found.items()))

"""The entries of what needs attention, found in a fleet's situation; one snapshot serves everybody for a moment."""

from __future__ import annotations

import hashlib
import threading
import time
from bisect import bisect_right
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property, lru_cache
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.attention.causes.contract import Finding, TimedCause
from app.attention.causes.registry import CAUSES
from app.attention.situation import Change, Situation, changed_satellites, newest_change, situations
from app.storage.database import utc_now

TRUSTED_S: Final = 5.0
"""A snapshot serves so long at most, for time passes even where nothing is written."""
AT_ONCE: Final = 150
"""Satellites that are asked for anew beside what is known of the others; of more, the whole fleet is."""
ORDER: Final = {code: number for number, code in enumerate(CAUSES)}
TIMED: Final = [cause for cause in CAUSES.values() if isinstance(cause, TimedCause)]
LONGEST: Final = timedelta(days=1)
"""A situation is judged anew after so long, whatever its causes say."""


@dataclass(frozen=True)
class Entry:
    """One magnetometer and cause."""

    id: str
    satellite_id: str
    magnetometer_id: str
    code: str
    finding: Finding

    @cached_property
    def rank(self) -> tuple[int, int, float, str]:
        """Its place in the list, the worst first, of equal ones the newest."""
        is_watch = int(self.finding.severity == "watch")
        return is_watch, ORDER[self.code], -self.finding.since.timestamp(), self.id


@dataclass(frozen=True, slots=True)
class Glance:
    """What the fleet is counted and sorted by: the worst that is left to do, how much, verdict and agreement."""

    state: str
    attention: int
    verdict: str
    agreement: str

    @property
    def kind(self) -> tuple[str, str, str]:
        """State, verdict and agreement."""
        return self.state, self.verdict, self.agreement


@dataclass(frozen=True)
class Standing:
    """A magnetometer's situation and what of it needs attention, until ``changes_at``, when the clock may change it.

    What follows from it is worked out once, for it is asked for with every page.
    """

    situation: Situation
    entries: Sequence[Entry]
    changes_at: datetime

    @cached_property
    def glance(self) -> Glance:
        """What it comes down to, with nothing acknowledged."""
        return self.glance_of(self.entries)

    def glance_of(self, left: Sequence[Entry]) -> Glance:
        """Return what it comes down to with the entries that are ``left``."""
        active, judged = self.situation.active, self.situation.judged
        is_act = any(entry.finding.severity == "act" for entry in left)
        return Glance(
            "act" if is_act else "watch" if left else "good",
            len(left),
            "none" if active is None else active.grade,
            (None if judged is None else judged.grade) or "none",
        )

    @cached_property
    def searched(self) -> str:
        """What a search looks into."""
        situation = self.situation
        names = (situation.satellite_id, situation.satellite_name, situation.magnetometer_id, situation.norad_id)
        return " ".join(name for name in names if name).casefold()

    @cached_property
    def name_order(self) -> tuple[str, str, str]:
        """Its place by name."""
        situation = self.situation
        name = (situation.satellite_name or situation.satellite_id).casefold()
        return name, situation.satellite_id, situation.magnetometer_id


@lru_cache(maxsize=100_000)
def entry_id(satellite_id: str, magnetometer_id: str, code: str) -> str:
    """Return what names a magnetometer's cause, the same for ever: 32 hexadecimal digits."""
    return hashlib.sha256(f"{satellite_id}/{magnetometer_id}/{code}".encode()).hexdigest()[:32]


def standing(situation: Situation, now: datetime) -> Standing:
    """Return what of a situation needs attention at ``now``."""
    where = situation.satellite_id, situation.magnetometer_id
    found = ((code, cause.find(situation, now)) for code, cause in CAUSES.items())
    entries = [Entry(entry_id(*where, code), *where, code, one) for code, one in found if one is not None]
    same = (cause.unchanged_for(situation, now) for cause in TIMED)
    return Standing(situation, entries, now + min((one for one in same if one is not None), default=LONGEST))


@dataclass(frozen=True, slots=True)
class View:
    """Magnetometers as lists show them, each order made once: by satellite and magnetometer, and by name.

    ``entries`` has what needs attention of them all, the worst first.
    """

    standings: Sequence[Standing]
    by_name: Sequence[Standing]
    entries: Sequence[Entry]


def view_of(standings: Iterable[Standing], before: View | None = None, leaving: Collection[str] = ()) -> View:
    """Return the view of ``standings``, and of those in ``before`` whose satellites are not ``leaving``.

    What is in order already is sorted in one pass.
    """
    new = list(standings)
    kept = View((), (), ()) if before is None else before
    places = [one for one in kept.standings if one.situation.satellite_id not in leaving]
    names = [one for one in kept.by_name if one.situation.satellite_id not in leaving]
    entries = [one for one in kept.entries if one.satellite_id not in leaving]
    return View(
        sorted([*places, *new], key=lambda one: (one.situation.satellite_id, one.situation.magnetometer_id)),
        sorted([*names, *new], key=lambda one: one.name_order),
        sorted([*entries, *(entry for one in new for entry in one.entries)], key=lambda one: one.rank),
    )


@dataclass(frozen=True, slots=True)
class _Snapshot:
    """``judged_at``: the latest time that something in it was judged at; ``made_s``: when all was looked at last."""

    change: Change
    judged_at: datetime
    made_s: float
    view: View


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

    def view(self, session: Session, caller: Caller) -> View:
        """Return what is known of every magnetometer that the caller reaches."""
        found = self._current(session)
        own = caller.satellites
        return found if own is None else view_of(one for one in found.standings if one.situation.satellite_id in own)

    def _current(self, session: Session) -> View:
        change = newest_change(session)
        with self._lock:
            known = self._snapshot
            is_old = known is None or time.monotonic() - known.made_s > TRUSTED_S
            if known is None or is_old or self._noted or known.change != change:
                known = self._snapshot = self._renewed(session, known, change, is_old=is_old)
            return known.view

    def _renewed(self, session: Session, known: _Snapshot | None, change: Change, *, is_old: bool) -> _Snapshot:
        """Return the snapshot of now: what changed since ``known`` asked for anew, of an old one what time changed."""
        now, now_s = utc_now(), time.monotonic()
        noted, self._noted = self._noted, set()
        changed = None if known is None else changed_satellites(session, known.change)
        if known is None or changed is None or len(changed) > AT_ONCE:
            return _Snapshot(change, now, now_s, view_of(standing(one, now) for one in situations(session)))
        changed |= noted
        if is_old:
            # Not every write is of a change that is told: all satellites are asked for in turns.
            changed |= self._in_turn(known.view)
        new = [standing(one, now) for one in situations(session, sorted(changed))] if changed else []
        timed = _timed(known, now, changed) if is_old else []
        leaving = changed | {one.situation.satellite_id for one in timed}
        judged_at = now if is_old else max(now, known.judged_at)
        made_s = now_s if is_old else known.made_s
        return _Snapshot(change, judged_at, made_s, view_of([*new, *timed], known.view, leaving))

    def _in_turn(self, known: View) -> set[str]:
        """Return the satellites whose turn it is, a part of a large fleet, all of a small one."""
        every = list(dict.fromkeys(one.situation.satellite_id for one in known.standings))
        begin = bisect_right(every, self._turn)
        turn = [*every[begin:], *every[:begin]][:AT_ONCE]
        self._turn = turn[-1] if turn else ""
        return set(turn)


def _timed(known: _Snapshot, now: datetime, changed: Collection[str]) -> list[Standing]:
    """Return anew what is known of the satellites that the clock has changed something of, less those ``changed``.

    A clock that was set back may change anything.
    """
    is_back = now < known.judged_at
    every = known.view.standings
    due = {one.situation.satellite_id for one in every if is_back or one.changes_at <= now}.difference(changed)
    return [standing(one.situation, now) for one in every if one.situation.satellite_id in due]

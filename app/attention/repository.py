"""What needs attention, as far as the caller's key reaches: listed, and acknowledged by people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.access.key_tables import ApiKey
from app.attention.entries import Entry, Fleet, Standing
from app.attention.schemas import (
    AcknowledgeBody,
    AcknowledgementRead,
    ActionRead,
    AttentionCounts,
    AttentionPage,
    AttentionQuery,
    AttentionRead,
    AttentionShort,
    AttentionShortPage,
    LinksRead,
)
from app.attention.tables import AttentionAcknowledgement
from app.errors import NotFoundError
from app.http.paging import CursorError, in_short
from app.parameter_sets.tables import ParameterSet
from app.satellites.repository import within_reach
from app.storage.database import utc_now

WITH_REASON: Final = frozenset({"set_refused", "active_weak", "no_active_set"})
"""Causes whose sentence says the first reason of the set's verdict too, read for those that are shown alone."""

Acknowledged = dict[str, AttentionAcknowledgement]


class AttentionRepository:
    """The entries that a caller reaches."""

    def __init__(self, session: Session, caller: Caller, fleet: Fleet) -> None:
        self.session = session
        self.caller = caller
        self._fleet = fleet

    def standings(self) -> tuple[Sequence[Standing], Acknowledged]:
        """Return the standing of every magnetometer, and the acknowledgements that hold."""
        return self._fleet.standings(self.session, self.caller), self._acknowledged(utc_now())

    def counts(self) -> AttentionCounts:
        """Return how many entries there are of each severity, and how many are acknowledged."""
        standings, known = self.standings()
        every = [entry for one in standings for entry in one.entries]
        return counted(every, {entry.id for entry in every if holds(known, entry)})

    def page(self, query: AttentionQuery) -> AttentionPage | AttentionShortPage:
        """Return a part of the entries, those that are acknowledged behind the others."""
        standings, known = self.standings()
        every = [entry for one in standings for entry in one.entries]
        seen = {entry.id for entry in every if holds(known, entry)}
        held = every
        if query.q is not None:
            held = [entry for one in standings for entry in one.entries if _has(one, entry, query.q)]
        fitting = _ordered([one for one in held if _fits(one, query, one.id in seen)], query.sort, seen)
        begin = _begin(fitting, query.cursor)
        shown = fitting[begin : begin + query.limit]
        after = shown[-1].id if begin + query.limit < len(fitting) else None
        total, counts = len(fitting) if query.total else None, counted(every, seen)
        items = self._read(shown, known)
        if query.view == "full":
            return AttentionPage(items=items, next=after, total=total, counts=counts)
        short = [in_short(one, AttentionShort) for one in items]
        return AttentionShortPage(items=short, next=after, total=total, counts=counts)

    def acknowledge(self, entry_id: str, body: AcknowledgeBody) -> AttentionRead:
        """Return the entry ``entry_id``, acknowledged by the caller."""
        entry = self._entry(entry_id)
        row = self.session.get(AttentionAcknowledgement, entry_id)
        if row is None:
            row = AttentionAcknowledgement(
                entry_id=entry.id, satellite_id=entry.satellite_id, magnetometer_id=entry.magnetometer_id
            )
            self.session.add(row)
        row.about, row.severity = entry.finding.about[:200], str(entry.finding.severity)
        row.note, row.until, row.at, row.by = body.note, body.until, utc_now(), self.caller.key_id
        subject = f"{entry.satellite_id}/{entry.magnetometer_id} {entry.code}"
        record_event(self.session, self.caller, "attention.acknowledge", subject, entry.satellite_id, reason=body.note)
        self.session.flush()
        return self._read([entry], {entry.id: row})[0]

    def _entry(self, entry_id: str) -> Entry:
        for one in self._fleet.standings(self.session, self.caller):
            for entry in one.entries:
                if entry.id == entry_id:
                    return entry
        raise NotFoundError("no such entry: what it was about may be over")

    def _acknowledged(self, now: datetime) -> Acknowledged:
        reached = within_reach(AttentionAcknowledgement.satellite_id, self.caller)
        rows = self.session.scalars(select(AttentionAcknowledgement).where(reached))
        return {row.entry_id: row for row in rows if row.until is None or row.until > now}

    def _read(self, entries: Sequence[Entry], known: Acknowledged) -> list[AttentionRead]:
        reasons = self._reasons([one for one in entries if one.code in WITH_REASON])
        seen = {one.id: known[one.id] for one in entries if holds(known, one)}
        authors = self._authors({row.by for row in seen.values()} - {None})
        return [_read(one, _acknowledgement(seen.get(one.id), authors), reasons) for one in entries]

    def _authors(self, key_ids: set[str | None]) -> dict[str, str | None]:
        """Return the name of each of the keys."""
        if not key_ids:
            return {}
        rows = self.session.execute(select(ApiKey.id, ApiKey.name).where(ApiKey.id.in_(key_ids)))
        return dict(rows.all())

    def _reasons(self, entries: Sequence[Entry]) -> dict[str, str]:
        """Return the first reason of each set that ``entries`` are about."""
        ids = [one.finding.links["parameter_set_id"] for one in entries if "parameter_set_id" in one.finding.links]
        if not ids:
            return {}
        record: Any = ParameterSet.record
        rows = self.session.execute(select(ParameterSet.id, record["verdict"]).where(ParameterSet.id.in_(ids)))
        return {set_id: str(verdict["reasons"][0]) for set_id, verdict in rows if verdict and verdict["reasons"]}


def holds(known: Acknowledged, entry: Entry) -> bool:
    """Return whether somebody has acknowledged the entry as it is: of the same matter, and no worse since."""
    row = known.get(entry.id)
    if row is None or row.about != entry.finding.about[:200]:
        return False
    return row.severity == "act" or entry.finding.severity == "watch"


def counted(entries: Sequence[Entry], seen: set[str]) -> AttentionCounts:
    """Return how many entries there are of each severity, those that are ``seen`` apart."""
    act = sum(one.finding.severity == "act" and one.id not in seen for one in entries)
    return AttentionCounts(act=act, watch=len(entries) - len(seen) - act, acknowledged=len(seen))


def _fits(entry: Entry, query: AttentionQuery, is_seen: bool) -> bool:
    finding = entry.finding
    asked = (
        (query.severity, finding.severity),
        (query.code, entry.code),
        (query.satellite, entry.satellite_id),
        (query.magnetometer, entry.magnetometer_id),
        (query.acknowledged, is_seen),
        (query.session, finding.links.get("session_id")),
    )
    return all(wanted is None or wanted == is_so for wanted, is_so in asked)


def _has(standing: Standing, entry: Entry, q: str) -> bool:
    """Return whether an entry, or what it is of, has the text ``q`` in a name."""
    names = (entry.code, entry.satellite_id, standing.situation.satellite_name, entry.magnetometer_id)
    return any(name is not None and q.casefold() in name.casefold() for name in names)


ORDERS: Final[Mapping[str, Callable[[Entry], tuple[object, ...]]]] = {
    "worst": lambda one: one.rank,
    "since": lambda one: (one.finding.since, one.id),
    "satellite": lambda one: (one.satellite_id, one.magnetometer_id, one.rank),
}


def _ordered(entries: Sequence[Entry], sort: str, seen: set[str]) -> list[Entry]:
    """Return ``entries`` in the order ``sort``, those that are ``seen`` behind the others."""
    found = sorted(entries, key=ORDERS[sort.removeprefix("-")], reverse=sort.startswith("-"))
    return sorted(found, key=lambda one: one.id in seen)


def _begin(entries: Sequence[Entry], cursor: str | None) -> int:
    """Return where the part behind ``cursor``, the id of an entry, begins.

    Raises
    ------
    CursorError
        There is no such entry any more: the list has changed under the reader, who begins anew.
    """
    if cursor is None:
        return 0
    for number, one in enumerate(entries):
        if one.id == cursor:
            return number + 1
    raise CursorError("the entry that the list was to go on behind is over: begin anew")


def _acknowledgement(
    row: AttentionAcknowledgement | None, authors: Mapping[str, str | None]
) -> AcknowledgementRead | None:
    if row is None:
        return None
    return AcknowledgementRead(by=row.by, author=authors.get(row.by or ""), at=row.at, until=row.until, note=row.note)


def _read(entry: Entry, seen: AcknowledgementRead | None, reasons: dict[str, str]) -> AttentionRead:
    finding = entry.finding
    reason = reasons.get(finding.links.get("parameter_set_id", "")) if entry.code in WITH_REASON else None
    action = finding.action
    return AttentionRead(
        id=entry.id,
        satellite_id=entry.satellite_id,
        magnetometer_id=entry.magnetometer_id,
        severity="act" if finding.severity == "act" else "watch",
        code=entry.code,
        text=finding.text if reason is None else f"{finding.text}: {reason.partition(': ')[2] or reason}",
        since=finding.since,
        links=LinksRead(**finding.links),
        action=None if action is None else ActionRead.model_validate(action),
        acknowledged=seen,
    )

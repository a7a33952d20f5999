"""What needs attention, as far as the caller's key reaches: listed, and acknowledged by people."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Any, Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.access.key_tables import ApiKey
from app.attention.entries import Entry, Fleet, Standing, View
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

    def known(self) -> tuple[View, Acknowledged]:
        """Return what is known of every magnetometer, and the acknowledgements that hold of what there is."""
        view = self._fleet.view(self.session, self.caller)
        rows = self._acknowledged(utc_now())
        entries = [entry for entry in view.entries if entry.id in rows] if rows else []
        return view, {entry.id: rows[entry.id] for entry in entries if _holds(rows[entry.id], entry)}

    def counts(self) -> AttentionCounts:
        """Return how many entries there are of each severity, and how many are acknowledged."""
        view, known = self.known()
        return _counted(view.entries, known)

    def page(self, query: AttentionQuery) -> AttentionPage | AttentionShortPage:
        """Return a part of the entries, those that are acknowledged behind the others."""
        view, known = self.known()
        held = view.entries
        if query.q is not None:
            named = {entry.id for one in view.standings for entry in one.entries if _has(one, entry, query.q)}
            held = [entry for entry in held if entry.id in named]
        fitting = _ordered(_fitting(held, query, known), query.sort, known)
        begin = _begin(fitting, query.cursor)
        shown = fitting[begin : begin + query.limit]
        after = shown[-1].id if begin + query.limit < len(fitting) else None
        total, counts = len(fitting) if query.total else None, _counted(view.entries, known)
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
        for entry in self._fleet.view(self.session, self.caller).entries:
            if entry.id == entry_id:
                return entry
        raise NotFoundError("no such entry: what it was about may be over")

    def _acknowledged(self, now: datetime) -> Acknowledged:
        reached = within_reach(AttentionAcknowledgement.satellite_id, self.caller)
        rows = self.session.scalars(select(AttentionAcknowledgement).where(reached))
        return {row.entry_id: row for row in rows if row.until is None or row.until > now}

    def _read(self, entries: Sequence[Entry], known: Acknowledged) -> list[AttentionRead]:
        reasons = self._reasons([one for one in entries if one.code in WITH_REASON])
        seen = {one.id: known[one.id] for one in entries if one.id in known}
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


def _holds(row: AttentionAcknowledgement, entry: Entry) -> bool:
    """Return whether ``row`` acknowledges the entry as it is: of the same matter, and no worse since."""
    if row.about != entry.finding.about[:200]:
        return False
    return row.severity == "act" or entry.finding.severity == "watch"


def _counted(entries: Sequence[Entry], known: Acknowledged) -> AttentionCounts:
    """Return how many entries, the worst first, there are of each severity, those that are acknowledged apart."""
    acts = bisect_right(entries, 0, key=lambda one: one.rank[0])
    seen_acts = sum(entry.id in known for entry in entries[:acts]) if known else 0
    left = len(entries) - len(known)
    return AttentionCounts(act=acts - seen_acts, watch=left - (acts - seen_acts), acknowledged=len(known))


def _fitting(entries: Sequence[Entry], query: AttentionQuery, known: Acknowledged) -> Sequence[Entry]:
    """Return those of ``entries`` that ``query`` asks for, in their order."""
    tests: list[tuple[Callable[[Entry], object], object]] = [
        (read, wanted)
        for read, wanted in (
            (lambda one: one.finding.severity, query.severity),
            (lambda one: one.code, query.code),
            (lambda one: one.satellite_id, query.satellite),
            (lambda one: one.magnetometer_id, query.magnetometer),
            (lambda one: one.id in known, query.acknowledged),
            (lambda one: one.finding.links.get("session_id"), query.session),
        )
        if wanted is not None
    ]
    return [one for one in entries if all(read(one) == wanted for read, wanted in tests)] if tests else entries


def _has(standing: Standing, entry: Entry, q: str) -> bool:
    """Return whether an entry, or what it is of, has the text ``q`` in a name."""
    names = (entry.code, entry.satellite_id, standing.situation.satellite_name, entry.magnetometer_id)
    return any(name is not None and q.casefold() in name.casefold() for name in names)


ORDERS: Final[Mapping[str, Callable[[Entry], tuple[object, ...]]]] = {
    "worst": lambda one: one.rank,
    "since": lambda one: (one.finding.since, one.id),
    "satellite": lambda one: (one.satellite_id, one.magnetometer_id, one.rank),
}


def _ordered(entries: Sequence[Entry], sort: str, known: Acknowledged) -> Sequence[Entry]:
    """Return ``entries``, which are in the order ``worst``, in the order ``sort``, those acknowledged at the end."""
    if sort != "worst":
        entries = sorted(entries, key=ORDERS[sort.removeprefix("-")], reverse=sort.startswith("-"))
    return sorted(entries, key=lambda one: one.id in known) if known else entries


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

"""Parameter sets and what was in force, as far as the caller's key reaches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import Boolean, ColumnElement, Select, case, func, or_, select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import Session
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.errors import ConflictError, NotFoundError, ReasonRequiredError, RefusedVerdictError
from app.http.paging import Part, Ways, fetch_page
from app.outbox.events import Event, parameter_set_activated, parameter_set_created
from app.outbox.log import append
from app.parameter_sets.schemas import ParameterSetQuery, ParameterSetRead
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.satellites.repository import within_reach
from app.satellites.tables import Magnetometer
from app.storage.database import new_id, utc_now
from app.storage.store import Store, digest, moments_key, residuals_key

SETS: Final = Ways(
    {"created": (ParameterSet.id,), "data_from": (ParameterSet.data_from, ParameterSet.id)},
    searched=(ParameterSet.id, ParameterSet.satellite_id, ParameterSet.magnetometer_id),
)
KEYS: Final[Mapping[str, Callable[[str], str]]] = {"residuals": residuals_key, "moments": moments_key}
"""What is kept beside a parameter set's row, and under which key."""


class ParameterSetRepository:
    """The parameter sets that a caller reaches."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def add(self, row: ParameterSet, session_ids: Sequence[str], blobs: Mapping[str, bytes], store: Store) -> None:
        """Keep a new parameter set with its ``residuals`` and, where its method leaves any, its ``moments``."""
        packed = {name: store.pack(content, digest(content)) for name, content in blobs.items()}
        row.residuals_sha256 = packed["residuals"].sha256
        row.moments_sha256 = packed["moments"].sha256 if "moments" in packed else None
        store.put_all(self.session, [(KEYS[name](row.id), one) for name, one in packed.items()])
        self.session.add(row)
        self.session.flush()
        self.session.add_all(ParameterSetSession(parameter_set_id=row.id, session_id=one) for one in session_ids)
        append(self.session, [_created(row)])

    def get(self, parameter_set_id: str) -> ParameterSet:
        """Return the parameter set ``parameter_set_id``."""
        reached = within_reach(ParameterSet.satellite_id, self.caller)
        row = self.session.scalar(select(ParameterSet).where(ParameterSet.id == parameter_set_id, reached))
        if row is None:
            raise NotFoundError("no such parameter set")
        return row

    def moments_sha256(self, parameter_set_id: str) -> str | None:
        """Return the digest of the moments of a parameter set; None where it has none."""
        reached = within_reach(ParameterSet.satellite_id, self.caller)
        statement = select(ParameterSet.moments_sha256).where(ParameterSet.id == parameter_set_id, reached)
        found = self.session.scalars(statement).all()
        if not found:
            raise NotFoundError("no such parameter set")
        return found[0]

    def in_force(self, satellite_id: str, magnetometer_id: str) -> ParameterSet | None:
        """Return the parameter set that is in force for a magnetometer, if any is."""
        reached = within_reach(ParameterSet.satellite_id, self.caller)
        place = (ParameterSet.satellite_id == satellite_id, ParameterSet.magnetometer_id == magnetometer_id)
        return self.session.scalar(select(ParameterSet).where(*place, ParameterSet.status == "active", reached))

    def page(self, query: ParameterSetQuery) -> Part[ParameterSet]:
        """Return a part of the parameter sets."""
        statement = select(ParameterSet).where(*matching(query, self.caller))
        return fetch_page(self.session, statement, SETS, query)

    def session_ids(self, rows: Sequence[ParameterSet]) -> dict[str, list[str]]:
        """Return the sessions of each parameter set."""
        found: dict[str, list[str]] = {row.id: [] for row in rows}
        link = ParameterSetSession
        links = select(link).where(link.parameter_set_id.in_(found)).order_by(link.session_id)
        for one in self.session.scalars(links):
            found[one.parameter_set_id].append(one.session_id)
        return found

    def read(self, rows: Sequence[ParameterSet]) -> list[ParameterSetRead]:
        """Return ``rows`` as the service tells of them."""
        sessions = self.session_ids(rows)
        return [
            ParameterSetRead.model_validate(
                row.record
                | {
                    "id": row.id,
                    "satellite": row.satellite_id,
                    "magnetometer": row.magnetometer_id,
                    "session_ids": sessions[row.id],
                    "job_id": row.job_id,
                    "status": row.status,
                    "created_at": row.created_at,
                }
            )
            for row in rows
        ]

    def activate(self, parameter_set_id: str, *, force: bool, reason: str | None = None) -> ParameterSet:
        """Return the parameter set, now the active one of its magnetometer; the one before is retired.

        ``reason``: why, which the audit trail keeps; one that is refused is put in force with a reason alone.
        """
        row = self.get(parameter_set_id)
        current = self._current(row)
        if row.status == "active":
            return row
        if row.grade == "refuse" and not force:
            raise RefusedVerdictError(
                "the verdict is refuse; send force=true with a reason to put it in force all the same"
            )
        if row.grade == "refuse" and reason is None:
            raise ReasonRequiredError("the verdict is refuse: say why it comes into force all the same (reason)")
        self._replace(current, row, None if current is None else current.id)
        record_event(self.session, self.caller, "parameter_set.activate", row.id, row.satellite_id, reason=reason)
        return row

    def rollback(self, parameter_set_id: str) -> ParameterSet:
        """Return the parameter set, no longer active; the one that it had replaced, if any, is active again."""
        row = self.get(parameter_set_id)
        current = self._current(row)
        if current is None or current.parameter_set_id != row.id:
            raise ConflictError("only the active parameter set can be rolled back")
        replaced = None if current.previous_id is None else self.session.get_one(Activation, current.previous_id)
        if replaced is None:
            self._replace(current, None, None)
        else:
            before = self.session.get_one(ParameterSet, replaced.parameter_set_id)
            self._replace(current, before, replaced.previous_id)
        record_event(self.session, self.caller, "parameter_set.rollback", row.id, row.satellite_id)
        return row

    def _current(self, row: ParameterSet) -> Activation | None:
        """Return the activation in force, with the magnetometer locked so that it stays so.

        What was read of ``row`` before the lock may have been another's to change, so it is read again.
        """
        place = (row.satellite_id, row.magnetometer_id)
        self.session.get_one(Magnetometer, place, with_for_update={"key_share": True})
        self.session.refresh(row)
        return self.session.scalar(
            select(Activation).where(
                Activation.satellite_id == row.satellite_id,
                Activation.magnetometer_id == row.magnetometer_id,
                Activation.ended_at.is_(None),
            )
        )

    def _replace(self, current: Activation | None, row: ParameterSet | None, previous_id: str | None) -> None:
        place = _magnetometer_of(current, row)
        now = self._next_moment(place.satellite_id, place.magnetometer_id)
        if current is not None:
            current.ended_at = now
            self.session.get_one(ParameterSet, current.parameter_set_id).status = "retired"
            self.session.flush()
        if row is not None:
            row.status = "active"
            self.session.add(
                Activation(
                    id=new_id(),
                    satellite_id=row.satellite_id,
                    magnetometer_id=row.magnetometer_id,
                    parameter_set_id=row.id,
                    previous_id=previous_id,
                    begun_at=now,
                    begun_by=self.caller.key_id,
                )
            )
            self.session.flush()
        append(self.session, [_activated(current, row, self.caller)])

    def _next_moment(self, satellite_id: str, magnetometer_id: str) -> datetime:
        """Return now, or a moment behind what was last: activations follow one another, whatever the clock does."""
        last = self.session.scalar(
            select(func.max(func.coalesce(Activation.ended_at, Activation.begun_at))).where(
                Activation.satellite_id == satellite_id, Activation.magnetometer_id == magnetometer_id
            )
        )
        return utc_now() if last is None else max(utc_now(), last + timedelta(microseconds=1))


def _created(row: ParameterSet) -> Event:
    return parameter_set_created(
        parameter_set_id=row.id,
        satellite_id=row.satellite_id,
        magnetometer_id=row.magnetometer_id,
        job_id=row.job_id,
        grade=row.grade,
        method=row.method,
    )


def _magnetometer_of(before: Activation | None, after: ParameterSet | None) -> Activation | ParameterSet:
    """Return what tells the magnetometer of which a set was in force before, or is so after."""
    place = after or before
    if place is None:
        raise ConflictError("neither a parameter set that was in force nor one that is")
    return place


def _activated(before: Activation | None, after: ParameterSet | None, caller: Caller) -> Event:
    place = _magnetometer_of(before, after)
    return parameter_set_activated(
        parameter_set_id=None if after is None else after.id,
        previous_id=None if before is None else before.parameter_set_id,
        satellite_id=place.satellite_id,
        magnetometer_id=place.magnetometer_id,
        by=caller.key_id,
    )


def matching(query: ParameterSetQuery, caller: Caller) -> list[ColumnElement[bool]]:
    """Return the conditions of the parameter sets that ``query`` asks for, its search aside, and the caller reaches."""
    found = [within_reach(ParameterSet.satellite_id, caller)]
    equal = {
        ParameterSet.satellite_id: query.satellite,
        ParameterSet.magnetometer_id: query.magnetometer,
        ParameterSet.job_id: query.job,
        ParameterSet.status: query.status,
        ParameterSet.method: query.method,
        ParameterSet.grade: query.grade,
    }
    found += [column == wanted for column, wanted in equal.items() if wanted is not None]
    if query.session is not None:
        link = ParameterSetSession
        of_session = select(link.parameter_set_id).where(link.session_id == query.session)
        found.append(ParameterSet.id.in_(of_session))
    if query.since is not None:
        found.append(ParameterSet.data_until >= query.since)
    if query.until is not None:
        found.append(ParameterSet.data_from <= query.until)
    if query.at is not None:
        found.append(_Among(ParameterSet.id, _in_force(query.at, query, caller).scalar_subquery()))
    return found


class _Among(FunctionElement[bool]):
    """Whether a column is among the values of a subquery that is asked once, before anything else.

    PostgreSQL takes a plain ``IN`` for a join, and may read the whole table in the order of the list until it has met
    enough of them.
    """

    inherit_cache = True
    type = Boolean()


@compiles(_Among, "sqlite")
def _among_sqlite(element: _Among, compiler: SQLCompiler, **kw: object) -> str:
    column, wanted = element.clauses
    return f"{compiler.process(column, **kw)} IN {compiler.process(wanted, **kw)}"


@compiles(_Among, "postgresql")
def _among_postgres(element: _Among, compiler: SQLCompiler, **kw: object) -> str:
    column, wanted = element.clauses
    return f"{compiler.process(column, **kw)} = ANY (ARRAY {compiler.process(wanted, **kw)})"


def _in_force(at: datetime, query: ParameterSetQuery, caller: Caller) -> Select[str | None]:
    """Return the parameter set in force at ``at`` of each magnetometer that is asked for.

    Activations of a magnetometer follow one another, so it is that of the last one begun, unless that had ended.
    """
    last = (
        select(case((or_(Activation.ended_at.is_(None), Activation.ended_at > at), Activation.parameter_set_id)))
        .where(
            Activation.satellite_id == Magnetometer.satellite_id,
            Activation.magnetometer_id == Magnetometer.id,
            Activation.begun_at <= at,
            or_(Activation.ended_at.is_(None), Activation.ended_at > Activation.begun_at),
        )
        .order_by(Activation.begun_at.desc())
        .limit(1)
        .scalar_subquery()
    )
    asked = [within_reach(Magnetometer.satellite_id, caller)]
    if query.satellite is not None:
        asked.append(Magnetometer.satellite_id == query.satellite)
    if query.magnetometer is not None:
        asked.append(Magnetometer.id == query.magnetometer)
    return select(last).select_from(Magnetometer).where(*asked)

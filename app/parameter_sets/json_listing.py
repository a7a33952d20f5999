"""Lists of parameter sets as text: a record goes into the answer as the database keeps it.

Reading records into objects and writing them out again takes a hundred times as long as copying them.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Text, cast, func, select, text

from app.access.caller import Caller
from app.errors import NotFoundError
from app.http.paging import cut, part_of
from app.http.schemas import utc_text
from app.parameter_sets.repository import SETS, matching
from app.parameter_sets.schemas import ParameterSetQuery, ParameterSetSummary
from app.parameter_sets.tables import ParameterSet, ParameterSetSession
from app.satellites.repository import within_reach

OWN: Final = ("id", "satellite", "magnetometer", "session_ids", "job_id", "status", "created_at")
"""What a parameter set's columns tell, whatever its record says of them."""
AS_WRITTEN: Final = '{"status": "candidate", '
"""How a record begins that a worker has written to SQLite."""
MOST_BYTES: Final = 32 << 20
"""Texts that a process keeps at hand."""


@dataclass(frozen=True, slots=True)
class Listed:
    """Which parameter sets an answer has, by id and status, and the cursor of the next part.

    A set never changes but for its status, so these make the whole answer what it is.
    """

    sets: Sequence[tuple[str, str]]
    cursor: str | None = None
    total: int | None = None
    view: str = "full"

    @property
    def tag(self) -> str:
        """The entity tag of the answer."""
        told = "\n".join(
            (
                _version(),
                self.cursor or "",
                str(self.total),
                self.view,
                *(f"{one} {status}" for one, status in self.sets),
            )
        )
        return f'"{hashlib.sha256(told.encode()).hexdigest()[:32]}"'


def listed(connection: Connection, caller: Caller, query: ParameterSetQuery) -> Listed:
    """Return a part of the list."""
    columns = (ParameterSet.id, ParameterSet.status, ParameterSet.data_from)
    statement = select(*columns).where(*matching(query, caller), SETS.holding(query))
    rows, cursor = cut(list(connection.execute(part_of(statement, SETS, query)).all()), SETS, query)
    total = None
    if query.total:
        total = connection.execute(select(func.count()).select_from(statement.subquery())).scalar_one()
    return Listed([(row.id, row.status) for row in rows], cursor, total, query.view)


def found(connection: Connection, caller: Caller, parameter_set_id: str) -> Listed:
    """Return one parameter set alone."""
    reached = within_reach(ParameterSet.satellite_id, caller)
    statement = select(ParameterSet.id, ParameterSet.status).where(ParameterSet.id == parameter_set_id, reached)
    row = connection.execute(statement).first()
    if row is None:
        raise NotFoundError("no such parameter set")
    return Listed([(row.id, row.status)])


class Texts:
    """Parameter sets in JSON, the latest that were asked for at hand; requests of several threads ask at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._texts: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._size = 0

    def of(self, connection: Connection, sets: Sequence[tuple[str, str]]) -> list[bytes]:
        """Return the JSON of each of ``sets``, which the caller reaches."""
        with self._lock:
            texts = {one: self._texts.get(one) for one in sets}
        missing = [one for one, content in texts.items() if content is None]
        if missing:
            texts |= self._read(connection, missing)
        return [content for content in texts.values() if content is not None]

    def _read(self, connection: Connection, sets: Sequence[tuple[str, str]]) -> dict[tuple[str, str], bytes]:
        read = _written(connection, dict(sets))
        with self._lock:
            for one, content in read.items():
                self._size += len(content) - len(self._texts.pop(one, b""))
                self._texts[one] = content
            while self._size > MOST_BYTES and self._texts:
                self._size -= len(self._texts.popitem(last=False)[1])
        return read


@dataclass(frozen=True, kw_only=True)
class ListingServices:
    """What lists of parameter sets add to what the application holds."""

    texts: Texts


def part(texts: Sequence[bytes], listed_sets: Listed) -> bytes:
    """Return a part of a list in JSON."""
    total = b"" if listed_sets.total is None else b',"total":%d' % listed_sets.total
    return b'{"items":[%b],"next":%b%b}' % (b",".join(texts), json.dumps(listed_sets.cursor).encode(), total)


def summaries(connection: Connection, listed_sets: Listed) -> list[bytes]:
    """Return each set of a list in JSON of under 500 bytes."""
    record: Any = ParameterSet.record
    own = ParameterSet
    statement = select(
        *(own.id, own.satellite_id, own.magnetometer_id, own.status, own.grade, own.method),
        *(own.data_from, own.data_until, own.created_at, record["statistics"]["after"]["rms_nt"].as_float()),
    ).where(own.id.in_([set_id for set_id, _ in listed_sets.sets]))
    names = list(ParameterSetSummary.model_fields)
    found = {row[0]: ParameterSetSummary(**dict(zip(names, row, strict=True))) for row in connection.execute(statement)}
    return [found[set_id].model_dump_json().encode() for set_id, _ in listed_sets.sets]


def _written(connection: Connection, statuses: dict[str, str]) -> dict[tuple[str, str], bytes]:
    """Return the JSON of parameter sets with the ``statuses`` that they were found with."""
    link = ParameterSetSession
    sessions = select(func.aggregate_strings(link.session_id, ",")).where(link.parameter_set_id == ParameterSet.id)
    statement = select(
        ParameterSet.id,
        ParameterSet.satellite_id,
        ParameterSet.magnetometer_id,
        ParameterSet.job_id,
        ParameterSet.created_at,
        sessions.scalar_subquery().label("sessions"),
        _record_text(connection).label("record"),
    ).where(ParameterSet.id.in_(statuses))
    rest = _tail if connection.dialect.name == "postgresql" else _rest
    return {
        (row.id, statuses[row.id]): (
            f'{{"id":"{row.id}","satellite":"{row.satellite_id}","magnetometer":"{row.magnetometer_id}",'
            f'"session_ids":{json.dumps(sorted((row.sessions or "").split(",")) if row.sessions else [])},'
            f'"job_id":"{row.job_id}","status":"{statuses[row.id]}","created_at":"{utc_text(row.created_at)}",'
            f"{rest(row.record)}"
        ).encode()
        for row in connection.execute(statement).all()
    }


def _record_text(connection: Connection) -> ColumnElement[str]:
    """Return the record as text; PostgreSQL's is rid of what the columns tell."""
    if connection.dialect.name != "postgresql":
        return cast(ParameterSet.record, Text)
    names = ", ".join(f"'{name}'" for name in OWN)
    return cast(ParameterSet.record.op("-")(text(f"ARRAY[{names}]")), Text)


def _tail(record: str) -> str:
    """Return a record in JSON without its first brace."""
    return record[1:]


def _rest(record: str) -> str:
    """Return a record in JSON without its first brace and without what the columns tell."""
    if record.startswith(AS_WRITTEN):
        return record[len(AS_WRITTEN) :]
    values = json.loads(record)
    return _tail(json.dumps({name: value for name, value in values.items() if name not in OWN}))


@cache
def _version() -> str:
    return version("magcal-service")

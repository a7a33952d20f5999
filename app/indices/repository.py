"""Index files and files of coefficients: kept once, for all satellites; of one kind of index the later holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
import zstandard
from sqlalchemy import ColumnElement, Select, and_, bindparam, exists, or_, select, union_all
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session, undefer

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM, Caller
from app.errors import NotFoundError, ScopeRequiredError
from app.http.paging import Part, Ways, fetch_page
from app.indices.schemas import FieldFileQuery, IndexQuery
from app.indices.tables import FieldFile, IndexFile
from app.storage.database import Base, new_id, utc_now
from app.storage.store import verified
from magcal_core.arrays import Times
from magcal_core.errors import IndexMissingError, OptionError
from magcal_core.field.coefficient_files import read_field_file
from magcal_core.field.coefficients import CoefficientFile
from magcal_core.field.index import INDEX_NAMES, Index
from magcal_core.field.models import FieldName
from magcal_core.field.sources import FieldSources

INDICES: Final = Ways(
    {"created": (IndexFile.created_at, IndexFile.id), "first": (IndexFile.first, IndexFile.id)},
    searched=(IndexFile.id, IndexFile.name, IndexFile.format, IndexFile.sha256),
)
FIELD_FILES: Final = Ways(
    {"created": (FieldFile.created_at, FieldFile.id)}, searched=(FieldFile.id, FieldFile.name, FieldFile.sha256)
)
MEMORY: Final = timedelta(hours=20_000)
"""How long before a session hours of the index count: the Earth's memory of them is 1e-10 nT by then."""
AROUND: Final = timedelta(hours=4)
"""Hours beside a session that its samples depend on: a neighbour, behind a gap that is bridged."""
HOUR: Final = timedelta(hours=1)
FIELD_FILE: Final = "field_file"
"""In a job's request, beside the options: the id of the file of coefficients."""


def _near() -> Select[IndexFile]:
    """Return the statement for the files that reach some data, and the last one of each kind, the oldest file first."""
    row = IndexFile
    since, till = (bindparam(name, type_=row.first.type) for name in ("since", "till"))
    lasts = [
        select(row.id).where(row.name == name).order_by(row.last.desc(), row.id).limit(1).subquery()
        for name in INDEX_NAMES
    ]
    reaches = and_(row.last >= since, row.first <= till)
    is_last = row.id.in_(union_all(*(select(last.c.id) for last in lasts)))
    return select(row).where(or_(reaches, is_last)).order_by(row.created_at, row.id)


NEAR: Final = _near()
"""Made once: to make it costs more than to execute it."""


class IndexRepository:
    """The index files and files of coefficients of this service."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller

    def add_index(self, content: bytes, index: Index) -> tuple[IndexFile, bool]:
        """Return the row of an index file, and whether it is new."""
        values = {
            "name": index.name,
            "format": index.format,
            "rows": index.rows,
            "missing": index.missing,
            "first": _instant(index.first_utc),
            "last": _instant(index.last_utc),
            "intervals": index.to_bytes(),
        }
        is_new = self._insert(IndexFile, content, index.sha256, values, "index.create")
        return self.session.scalars(select(IndexFile).where(IndexFile.sha256 == index.sha256)).one(), is_new

    def add_field_file(self, content: bytes, file: CoefficientFile) -> tuple[FieldFile, bool]:
        """Return the row of a file of coefficients, and whether it is new."""
        details = {name: value for name, value in file.to_dict().items() if name not in ("name", "sha256")}
        is_new = self._insert(FieldFile, content, file.sha256, {"name": file.name, "details": details}, "field.create")
        return self.session.scalars(select(FieldFile).where(FieldFile.sha256 == file.sha256)).one(), is_new

    def _insert(self, kind: type[Base], content: bytes, sha256: str, values: Mapping[str, object], action: str) -> bool:
        """Keep a file; one with the same bytes, also where another request has kept it meanwhile, is passed over."""
        own = {"id": new_id(), "sha256": sha256, "created_at": utc_now(), "created_by": self.caller.key_id}
        insert = postgresql.insert if self.session.get_bind().dialect.name == "postgresql" else sqlite.insert
        statement = insert(kind).on_conflict_do_nothing(index_elements=["sha256"])
        packed = zstandard.compress(content)
        result = self.session.execute(statement, [{**own, **values, "content": packed}])
        found = self.session.execute(select(kind.metadata.tables[kind.__tablename__].c.id).filter_by(sha256=sha256))
        is_new = bool(found.scalar_one() == own["id"])
        result.close()
        if is_new:
            record_event(self.session, self.caller, action, str(own["id"]))
        return is_new

    def index(self, index_id: str) -> IndexFile:
        """Return the index file ``index_id``."""
        row = self.session.get(IndexFile, index_id)
        if row is None:
            raise NotFoundError("no such index")
        return row

    def field_file(self, file_id: str) -> FieldFile:
        """Return the file of coefficients ``file_id``."""
        row = self.session.get(FieldFile, file_id)
        if row is None:
            raise NotFoundError("no such field file")
        return row

    def page(self, query: IndexQuery) -> Part[IndexFile]:
        """Return a part of the index files."""
        statement = select(IndexFile)
        if query.name is not None:
            statement = statement.where(IndexFile.name == query.name)
        if query.at is not None:
            statement = statement.where(IndexFile.first <= query.at, IndexFile.last > query.at)
        return fetch_page(self.session, statement, INDICES, query)

    def page_of_field_files(self, query: FieldFileQuery) -> Part[FieldFile]:
        """Return a part of the files of coefficients."""
        return fetch_page(self.session, select(FieldFile), FIELD_FILES, query)

    # ------------------------------------------------------------------------------------------------ what jobs take

    def intervals_near(self, begin: datetime, end: datetime) -> list[bytes]:
        """Return the intervals of the files that may drive a field from ``begin`` to ``end``, the oldest file first.

        A file whose hours all came again in later ones is left out. Of a kind of which none reaches there the last one
        is given: it says where the index ends.
        """
        asked = {"since": _at(begin - MEMORY - AROUND), "till": _at(end + AROUND)}
        rows = self.session.scalars(NEAR, asked).all()
        kept = _not_replaced([row for row in rows if row.last >= asked["since"] and row.first <= asked["till"]])
        for name in set(INDEX_NAMES) - {row.name for row in kept}:
            latest = max((row.last for row in rows if row.name == name), default=None)
            kept += [row for row in rows if row.name == name and row.last == latest][:1]
        if not kept:
            return []
        wanted = select(IndexFile.id, IndexFile.intervals).where(IndexFile.id.in_([row.id for row in kept]))
        by_id: dict[str, bytes] = {str(row[0]): bytes(row[1]) for row in self.session.execute(wanted)}
        return [by_id[row.id] for row in kept]

    def field_file_content(self, file_id: str) -> tuple[str | None, bytes]:
        """Return name and bytes of the file of coefficients ``file_id``, checked against their digest."""
        return self._content(FieldFile.id == file_id)

    def sources(
        self, begin: datetime, end: datetime, file_id: str | None = None, *, sha256: str | None = None
    ) -> FieldSources:
        """Return what a field from ``begin`` to ``end`` may be made from: indices, and a file by its id or digest."""
        file = None
        if file_id is not None or sha256 is not None:
            file = self._content(FieldFile.id == file_id if sha256 is None else FieldFile.sha256 == sha256)
        return sources_of(self.intervals_near(begin, end), file)

    def _content(self, which: ColumnElement[bool]) -> tuple[str | None, bytes]:
        row = self.session.scalars(select(FieldFile).where(which).options(undefer(FieldFile.content))).one_or_none()
        if row is None:
            raise NotFoundError("no such field file")
        return row.name, verified(f"field_file/{row.id}", zstandard.decompress(row.content), row.sha256)

    def check(self, field: str, *, file_id: str | None, is_quiet_only: bool) -> None:
        """Raise where a job with this field model would lack an index or a file for certain.

        Raises
        ------
        IndexMissingError, OptionError, NotFoundError
            There is no index of a kind that is needed, or the file is not there or not needed.
        """
        parts = FieldName.parse(field)
        if file_id is not None:
            self.field_file(file_id)
        if parts is not None and parts.has_file != (file_id is not None):
            which = "needs a field_file" if parts.has_file else "takes no field_file"
            raise OptionError(f"field: {field} {which}")
        if parts is not None and parts.needs is not None and not self._has(parts.needs):
            raise IndexMissingError(f"field {field} needs the index {parts.needs}, which is not there")
        if is_quiet_only and not (self._has("Kp") and (self._has("RC") or self._has("Dst"))):
            raise IndexMissingError("quiet_only needs the index Kp and an hourly one, RC or Dst")

    def _has(self, name: str) -> bool:
        return bool(self.session.scalar(select(exists().where(IndexFile.name == name))))


def require_unbound(caller: Caller) -> None:
    """Raise `ScopeRequiredError` where the caller's key is bound to satellites: these files serve all of them."""
    if caller.satellites is not None:
        raise ScopeRequiredError("the key is bound to satellites; a file that serves all of them needs one that is not")


def check_field(session: Session, request: Mapping[str, object]) -> None:
    """Raise where the field of a calibration's ``request`` needs an index or a file that is not there."""
    file_id = request.get(FIELD_FILE)
    IndexRepository(session, SYSTEM).check(
        str(request["field"]),
        file_id=None if file_id is None else str(file_id),
        is_quiet_only=bool(request.get("quiet_only")),
    )


def sources_of(intervals: Sequence[bytes], file: tuple[str | None, bytes] | None) -> FieldSources:
    """Return the sources of a field from what the repository gave."""
    indices = tuple(Index.from_bytes(one) for one in intervals)
    return FieldSources(indices, None if file is None else read_field_file(file[1], file[0]))


def sources_of_record(session: Session, record: Mapping[str, object], t_utc: Times) -> FieldSources:
    """Return what the field model of a parameter set takes at ``t_utc``: today's index, and its own coefficients."""
    parts, provenance = FieldName.parse(str(record.get("field_model", ""))), record.get("provenance")
    if parts is None or not (parts.has_file or parts.needs) or not len(t_utc):
        return FieldSources()
    file = provenance.get("field_file") if isinstance(provenance, Mapping) else None
    sha256 = str(file["sha256"]) if parts.has_file and isinstance(file, Mapping) else None
    known = t_utc[~np.isnat(t_utc)]
    return IndexRepository(session, SYSTEM).sources(*span_of(known), sha256=sha256)


def span_of(t_utc: Times) -> tuple[datetime, datetime]:
    """Return the first and the last of ``t_utc``, shape (n,), as the repository takes them."""
    return _instant(t_utc.min()), _instant(t_utc.max())


def _instant(t_utc: np.datetime64) -> datetime:
    """Return a time of the core, rounded down to microseconds."""
    microseconds = int(t_utc.astype("datetime64[us]").astype(np.int64))
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)


def _at(time: datetime) -> datetime:
    return max(time, datetime(1, 1, 2, tzinfo=UTC))


def _not_replaced(rows: Sequence[IndexFile]) -> list[IndexFile]:
    """Return ``rows`` without those that a later one of the same kind without gaps covers."""
    whole: dict[str, list[IndexFile]] = {}
    kept = []
    for row in reversed(rows):
        later = whole.setdefault(row.name, [])
        if any(one.first <= row.first and row.last <= one.last for one in later):
            continue
        kept.append(row)
        if row.missing == 0 and row.name != "Kp" and (row.last - row.first) == row.rows * HOUR:
            later.append(row)
    return kept[::-1]

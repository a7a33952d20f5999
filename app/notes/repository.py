"""Notes, as far as the caller's key reaches."""

from __future__ import annotations

from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.access.key_tables import ApiKey
from app.http.paging import Ways, fetch_page, page_of
from app.http.schemas import Page
from app.notes.schemas import NoteQuery, NoteRead, NoteShort
from app.notes.tables import Note
from app.storage.database import new_id, utc_now

NOTES: Final = Ways({"created": (Note.id,)}, searched=(Note.text,))


class NoteRepository:
    """The notes beside one thing, whose satellite the caller reaches."""

    def __init__(self, session: Session, caller: Caller, kind: str, subject: str, satellite_id: str) -> None:
        self.session = session
        self.caller = caller
        self._own = {"kind": kind, "subject": subject, "satellite_id": satellite_id}

    def add(self, text: str) -> NoteRead:
        """Return the new note ``text``."""
        row = Note(id=new_id(), **self._own, text=text, created_at=utc_now(), created_by=self.caller.key_id)
        self.session.add(row)
        record_event(self.session, self.caller, "note.create", f"{row.kind} {row.subject}", row.satellite_id)
        self.session.flush()
        return self._read([row])[0]

    def page(self, query: NoteQuery) -> Page[NoteRead] | Page[NoteShort]:
        """Return a part of the notes."""
        found = fetch_page(self.session, select(Note).filter_by(**self._own), NOTES, query)
        return page_of(self._read(found.rows), found, query, NoteShort)

    def _read(self, rows: list[Note]) -> list[NoteRead]:
        writers = {row.created_by for row in rows} - {None}
        names = dict(self.session.execute(select(ApiKey.id, ApiKey.name).where(ApiKey.id.in_(writers))).all())
        return [
            NoteRead(
                id=row.id,
                kind=row.kind,
                subject=row.subject,
                satellite=row.satellite_id,
                text=row.text,
                created_at=row.created_at,
                created_by=row.created_by,
                author=names.get(row.created_by or ""),
            )
            for row in rows
        ]

"""Pull telemetry from an archive into sessions, as if it had been uploaded; over kills nothing is lost or kept twice.

A page becomes a session in the transaction that moves the mark behind it, and in which it is remembered which rows
were taken: looking back finds what came late, and nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import SYSTEM
from app.connectors.tables import ConnectorMark
from app.connectors.telemetry.contract import Archive, Page, PullOptionError, Wanted, table_of
from app.connectors.telemetry.looking_back import Memory, Row
from app.errors import ConflictError
from app.http.receiving import Upload
from app.satellites.repository import SatelliteRepository
from app.sessions.schemas import UploadQuery
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.exclusive import Exclusive
from app.storage.retry import retried
from app.uploads.ingest import Asked, Ingest, Kept

NEEDED: Final = ("bx", "by", "bz")


@dataclass(frozen=True, slots=True)
class Pulled:
    """What a page became: its session, None where it had no rows."""

    rows: int
    session_id: str | None
    is_new: bool


class Pull:
    """One magnetometer's telemetry from one archive; ``name`` says which, and the mark is kept under it."""

    def __init__(
        self, database: Database, settings: Settings, ingest: Ingest, *, archive: tuple[str, Archive],
        satellite_id: str, magnetometer_id: str, wanted: Wanted,
    ) -> None:  # fmt: skip
        self._database = database
        self._ingest = ingest
        self._kind, self._archive = archive
        self._place = (satellite_id, magnetometer_id)
        place = hashlib.sha256(f"{wanted.base_url} {wanted.dataset}".encode()).hexdigest()[:16]
        self.name = f"{self._kind}/{satellite_id}/{magnetometer_id}/{place}"
        self._right = Exclusive(database, settings, f"pull-{self.name.replace('/', '-')}")
        self._wanted, self._columns = self._with_columns(wanted)
        self._needed = [self._wanted.columns[name] for name in NEEDED]
        self._memory = Memory(self.name, None, None, None)

    def run(self) -> Iterator[Pulled]:
        """Yield what each page became, up to the end of what the archive has now.

        Raises
        ------
        ConflictError
            Another process pulls the same, or the satellite has been removed and made anew meanwhile.
        """
        if not self._right.acquire():
            raise ConflictError("another process pulls the same telemetry")
        try:
            now, look_back = utc_now(), self._wanted.look_back
            self._memory = self._database.transact(lambda session: Memory.of(session, self.name, look_back, now))
            wanted = replace(self._wanted, again_from=self._memory.again_from)
            for page in self._archive.pages(wanted, self._memory.mark, now - wanted.settle):
                yield self._keep(page)
            self._database.transact(lambda session: self._memory.looked(session, now))
        finally:
            self._right.release()

    def _with_columns(self, wanted: Wanted) -> tuple[Wanted, dict[str, str] | None]:
        """Return ``wanted`` with the magnetometer's own map of columns where it has none, and that map."""
        with self._database.read() as session:
            satellites = SatelliteRepository(session, SYSTEM)
            columns = satellites.magnetometer(*self._place).columns
            norad_id = satellites.get(self._place[0]).norad_id
        if wanted.dataset is None and self._kind == "satnogs" and norad_id is not None:
            wanted = replace(wanted, dataset=norad_id.lstrip("0"))
        if not wanted.columns:
            wanted = replace(wanted, columns=columns or {})
        missing = [name for name in NEEDED if name not in wanted.columns]
        if missing:
            raise PullOptionError(f"--columns or the magnetometer's columns must name {', '.join(missing)}")
        return wanted, columns

    def _keep(self, page: Page) -> Pulled:
        rows = self._memory.new(page, self._needed)
        if not rows:
            retried(lambda: self._move(page.mark, []))
            return Pulled(0, None, is_new=False)
        content = table_of(rows, self._wanted, self._columns)
        upload = Upload(content, hashlib.sha256(content).hexdigest(), "text/csv")
        satellite_id, magnetometer_id = self._place
        asked = Asked(SYSTEM, satellite_id, UploadQuery(magnetometer=magnetometer_id), upload, None)
        prepared = self._ingest.prepare(asked)
        if isinstance(prepared, Kept):
            retried(lambda: self._move(page.mark, rows))
            return Pulled(len(rows), prepared.session.id, is_new=False)

        def keep() -> tuple[Kept, list[int]]:
            with self._database.write() as session:
                kept = self._ingest.write(session, [prepared])[0]
                return kept, self._mark(session, page.mark, rows)

        kept, keys = retried(keep)
        self._memory.hold(keys, page.mark)
        self._ingest.tell(prepared, kept)
        return Pulled(len(rows), kept.session.id, kept.is_new)

    def _move(self, mark: str, rows: Sequence[Row]) -> None:
        with self._database.write() as session:
            keys = self._mark(session, mark, rows)
        self._memory.hold(keys, mark)

    def _mark(self, session: Session, mark: str, rows: Sequence[Row]) -> list[int]:
        """Move the mark from where this pull has it, and remember the rows that are taken; return their keys.

        It is elsewhere where the satellite was removed and made anew.
        """
        row = session.get(ConnectorMark, self.name)
        if (None if row is None else row.mark) not in {self._memory.mark, mark}:
            raise ConflictError("the satellite has been removed and made anew: its pull begins from the start")
        now, satellite_id = utc_now(), self._place[0]
        if row is None:
            row = ConnectorMark(name=self.name, satellite_id=satellite_id, remembers_from=self._memory.keeps_from)
            session.add(row)
        row.mark, row.updated_at = mark, now
        return self._memory.remember(session, satellite_id, rows, self._needed)

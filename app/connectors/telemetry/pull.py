"""Pull telemetry from an archive into sessions, as if it had been uploaded; over kills nothing is lost or kept twice.

A page becomes a session in the transaction that moves the mark behind it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

from sqlalchemy.orm import Session

from app.access.caller import SYSTEM
from app.connectors.tables import ConnectorMark
from app.connectors.telemetry.contract import Archive, Page, PullOptionError, Wanted, table_of
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
        self._reached: str | None = None
        self._wanted, self._columns = self._with_columns(wanted)

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
            with self._database.read() as session:
                row = session.get(ConnectorMark, self.name)
            self._reached = None if row is None else row.mark
            for page in self._archive.pages(self._wanted, self._reached, utc_now() - self._wanted.settle):
                kept = self._keep(page)
                self._reached = page.mark
                yield kept
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
        if not page.rows:
            retried(lambda: self._move(page.mark))
            return Pulled(0, None, is_new=False)
        content = table_of(page.rows, self._wanted, self._columns)
        upload = Upload(content, hashlib.sha256(content).hexdigest(), "text/csv")
        satellite_id, magnetometer_id = self._place
        asked = Asked(SYSTEM, satellite_id, UploadQuery(magnetometer=magnetometer_id), upload, None)
        prepared = self._ingest.prepare(asked)
        if isinstance(prepared, Kept):
            retried(lambda: self._move(page.mark))
            return Pulled(len(page.rows), prepared.session.id, is_new=False)

        def keep() -> Kept:
            with self._database.write() as session:
                kept = self._ingest.write(session, [prepared])[0]
                self._mark(session, page.mark)
                return kept

        kept = retried(keep)
        self._ingest.tell(prepared, kept)
        return Pulled(len(page.rows), kept.session.id, kept.is_new)

    def _move(self, mark: str) -> None:
        with self._database.write() as session:
            self._mark(session, mark)

    def _mark(self, session: Session, mark: str) -> None:
        """Move the mark from where this pull has it; it is elsewhere where the satellite was removed and made anew."""
        row = session.get(ConnectorMark, self.name)
        if (None if row is None else row.mark) not in {self._reached, mark}:
            raise ConflictError("the satellite has been removed and made anew: its pull begins from the start")
        now = utc_now()
        session.merge(ConnectorMark(name=self.name, satellite_id=self._place[0], mark=mark, updated_at=now))

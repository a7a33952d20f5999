"""Rows that come late: a pull looks back behind its mark, and remembers what it took, so that none comes twice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from app.connectors.tables import ConnectorMark, ConnectorSeen
from app.connectors.telemetry.contract import TIME, Page, instant
from app.storage.database import new_id

LOOKS: Final = 24
"""A pull looks back so often within the time that it looks back."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND: Final = timedelta(microseconds=1)
Row = Mapping[str, str]


@dataclass(slots=True)
class Memory:
    """What one pull took of late, and whether it looks back now.

    Attributes
    ----------
    mark : how far the pull has come; None before the first page.
    keeps_from : rows younger than this are remembered; None: none is.
    again_from : from where archives are asked anew; None: only behind the mark.
    """

    name: str
    mark: str | None
    keeps_from: datetime | None
    again_from: datetime | None
    _seen: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, session: Session, name: str, look_back: timedelta, now: datetime) -> Memory:
        """Return what the pull ``name`` remembers of the last ``look_back``, and forget what is older."""
        row = session.get(ConnectorMark, name)
        mark = None if row is None else row.mark
        if not look_back:
            if row is not None:
                row.remembers_from = None
            return cls(name, mark, None, None)
        first = now - look_back
        session.execute(delete(ConnectorSeen).where(ConnectorSeen.name == name, ConnectorSeen.until < first))
        if row is None:
            return cls(name, None, first, None)
        if row.remembers_from is None:
            session.execute(delete(ConnectorSeen).where(ConnectorSeen.name == name))
        row.remembers_from = now if row.remembers_from is None else max(row.remembers_from, first)
        is_due = row.looked_back_at is None or now >= row.looked_back_at + look_back / LOOKS
        blobs = session.scalars(select(ConnectorSeen.times).where(ConnectorSeen.name == name))
        seen = {int(time) for blob in blobs for time in np.frombuffer(blob, "<i8")}
        return cls(name, mark, row.remembers_from, row.remembers_from if is_due else None, seen)

    def new(self, page: Page, needed: Sequence[str]) -> list[Row]:
        """Return the rows of a page that were not taken yet; of one behind the mark, none unless one of them is whole.

        A row that lacked one of the ``needed`` values is taken again once it has them all.
        """
        if not self._seen and self.again_from is None:
            return list(page.rows)
        found = [row for row in page.rows if not self._is_known(_key(row, needed))]
        is_worth = page.mark != self.mark or any(_key(row, needed) > 0 for row in found)
        return found if is_worth else []

    def _is_known(self, key: int) -> bool:
        return key in self._seen or (key < 0 and -key in self._seen)

    def remember(self, session: Session, satellite_id: str, rows: Sequence[Row], needed: Sequence[str]) -> list[int]:
        """Write down in the transaction that rows are taken; return what `hold` is to be told once it is durable."""
        if self.keeps_from is None:
            return []
        keys = [_key(row, needed) for row in rows]
        first = _microseconds(self.keeps_from)
        kept = [key for key in keys if abs(key) >= first]
        if kept:
            until = _EPOCH + max(map(abs, kept)) * _MICROSECOND
            times = np.array(kept, "<i8").tobytes()
            session.add(ConnectorSeen(id=new_id(), name=self.name, satellite_id=satellite_id, until=until, times=times))
        return kept

    def hold(self, keys: Sequence[int], mark: str) -> None:
        """Take over what has become durable."""
        self._seen.update(keys)
        self.mark = mark

    def looked(self, session: Session, now: datetime) -> None:
        """Write down that the pull has come to its end, and so has looked back where it did."""
        row = session.get(ConnectorMark, self.name)
        if row is not None and (self.again_from is not None or row.looked_back_at is None):
            row.looked_back_at = now


def _key(row: Row, needed: Sequence[str]) -> int:
    """Return the time of a row, microseconds since 1970; negative where it lacks a value that is needed."""
    time = _microseconds(instant(row[TIME]))
    return time if all(row.get(name) for name in needed) else -time


def _microseconds(time: datetime) -> int:
    return (time - _EPOCH) // _MICROSECOND

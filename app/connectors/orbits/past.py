"""Which elements of the past a satellite lacks: those about sessions that no orbit is near.

What a source has of the past does not change, so that a span is asked for once; which ones were is kept.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.connectors.tables import ConnectorMark
from app.orbits.tables import OrbitRow
from app.satellites.tables import Satellite
from app.sessions.tables import TelemetrySession
from app.storage.database import utc_now

NEAR: Final = timedelta(days=1)
"""An orbit with its epoch this near serves a session; catalogues have one or more a day."""
AROUND: Final = timedelta(days=2)
"""Elements are asked for from so long before a session to so long behind it."""
LATE: Final = timedelta(days=1)
"""What is younger is no past yet: elements about it are still to come."""
BRIDGED: Final = timedelta(days=30)
"""Sessions so near to each other are asked for together, with what is between them."""
LONGEST: Final = timedelta(days=366)


@dataclass(frozen=True, slots=True)
class Span:
    """Days of which elements are wanted, from ``first`` up to ``last``, which is not one of them."""

    first: date
    last: date


def lacking(session: Session, source: str, satellite_id: str) -> Span | None:
    """Return the earliest days about sessions without an orbit near that ``source`` was not asked for, None: none."""
    asked = _asked(session, source, satellite_id)
    orbits = session.execute(
        select(OrbitRow.epoch, OrbitRow.until).where(
            OrbitRow.satellite_id == satellite_id, OrbitRow.withdrawn_at.is_(None)
        )
    ).all()
    ends = [(row.epoch, row.until or row.epoch) for row in orbits]
    found: Span | None = None
    for begin, end in _sessions(session, satellite_id):
        own = Span((begin - AROUND).date(), (end + AROUND).date() + timedelta(days=1))
        if all(_is_near(ends, one) for one in (begin, end)) or _holds(asked, own):
            continue
        if found is None:
            found = own
        elif own.first - found.last <= BRIDGED and own.last - found.first <= LONGEST:
            found = Span(found.first, max(found.last, own.last))
        else:
            break
    return found


def note(session: Session, source: str, satellite_id: str, span: Span) -> None:
    """Write down that ``source`` was asked for ``span``, and has answered."""
    spans = [[str(one.first), str(one.last)] for one in (*_asked(session, source, satellite_id), span)]
    name = _name(session, source, satellite_id)
    mark = json.dumps(spans)
    session.merge(ConnectorMark(name=name, satellite_id=satellite_id, mark=mark, updated_at=utc_now()))


def _name(session: Session, source: str, satellite_id: str) -> str:
    """Return the mark's name; a satellite that was removed and comes again has another one."""
    created_at = session.scalars(select(Satellite.created_at).where(Satellite.id == satellite_id)).one()
    return f"orbits-of-the-past/{source}/{satellite_id}/{created_at.timestamp():.0f}"


def _asked(session: Session, source: str, satellite_id: str) -> list[Span]:
    row = session.get(ConnectorMark, _name(session, source, satellite_id))
    pairs = [] if row is None else json.loads(row.mark)
    return [Span(date.fromisoformat(first), date.fromisoformat(last)) for first, last in pairs]


def _sessions(session: Session, satellite_id: str) -> list[tuple[datetime, datetime]]:
    rows = session.execute(
        select(TelemetrySession.data_from, TelemetrySession.data_until)
        .where(TelemetrySession.satellite_id == satellite_id, TelemetrySession.data_until < utc_now() - LATE)
        .order_by(TelemetrySession.data_from)
    )
    return [(begin.astimezone(UTC), end.astimezone(UTC)) for begin, end in rows if begin and end]


def _is_near(orbits: Sequence[tuple[datetime, datetime]], at: datetime) -> bool:
    return any(epoch - NEAR <= at <= until + NEAR for epoch, until in orbits)


def _holds(spans: Sequence[Span], own: Span) -> bool:
    return any(one.first <= own.first and own.last <= one.last for one in spans)

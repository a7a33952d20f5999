"""Which rows name an object: what decides whether it must be there, may be removed, or is nobody's."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.jobs.tables import Job
from app.parameter_sets.tables import ParameterSet
from app.sessions.tables import Chunk, TelemetrySession

KINDS: Final = frozenset({"raw", "columns", "residuals", "moments", "series"})
"""What an object's key begins with."""
MOST_DIGITS: Final = 9
"""Of a chunk's number, which is an integer of 32 bits."""


class Naming(StrEnum):
    """What the rows say of an object."""

    NEEDED = "needed"
    GIVEN_UP = "given up"
    UNNAMED = "unnamed"


@dataclass(frozen=True, slots=True)
class Named:
    """What the rows say of an object, and the digest that it must have where one needs it."""

    naming: Naming
    sha256: str | None = None


NOBODY: Final = Named(Naming.UNNAMED)


def naming_of(session: Session, key: str) -> Named:
    """Return whether a row needs the object under ``key``, has given it up, or none knows of it."""
    kind, _, rest = key.partition("/")
    first, _, second = rest.partition("/")
    if kind == "raw":
        return _by_sessions(session, (TelemetrySession.satellite_id == first) & (Chunk.sha256 == second), Chunk.sha256)
    if kind == "columns" and second.isdecimal() and len(second) <= MOST_DIGITS:
        place = (Chunk.session_id == first) & (Chunk.sequence == int(second))
        return _by_sessions(session, place, Chunk.columns_sha256)
    if kind in {"residuals", "moments"}:
        column = ParameterSet.residuals_sha256 if kind == "residuals" else ParameterSet.moments_sha256
        sha256 = session.scalar(select(column).where(ParameterSet.id == rest))
        return NOBODY if sha256 is None else Named(Naming.NEEDED, sha256)
    if kind == "series":
        series = (session.scalar(select(Job.result).where(Job.id == rest)) or {}).get("series")
        return Named(Naming.NEEDED, str(series["sha256"])) if isinstance(series, dict) else NOBODY
    return NOBODY


def _by_sessions(session: Session, which: ColumnElement[bool], digest: InstrumentedAttribute[str]) -> Named:
    """Return what the sessions say that have a chunk ``which``: one that lives needs it, however many are removed."""
    asked = select(digest, TelemetrySession.raw_removed_at).select_from(Chunk).join(TelemetrySession).where(which)
    rows = session.execute(asked).all()
    living = [sha256 for sha256, removed_at in rows if removed_at is None]
    if living:
        return Named(Naming.NEEDED, living[0])
    return Named(Naming.GIVEN_UP) if rows else NOBODY

"""Keep every satellite's orbit fresh, with the manners that catalogues ask for.

One request an object in `MAGCAL_ORBIT_EVERY_H` hours, whatever is restarted, killed or removed meanwhile: it is written
down before it is sent, and satellites of one catalogue number share the answer. Any answer but 200 stops the source
until a person starts it again. One process at a time asks.
Where a source has the past, too, the elements about sessions that no orbit is near are fetched, each span once.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from random import SystemRandom
from typing import Final

import structlog
from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.connectors.errors import SourceAnswerError, SourceContentError, SourceUnreachableError
from app.connectors.orbits import past
from app.connectors.orbits.contract import OrbitSource, PastSource, Reply, Watched
from app.connectors.orbits.registry import ORBIT_SOURCES
from app.connectors.tables import ConnectorRequest, ConnectorStop
from app.errors import NotFoundError, UnavailableError
from app.orbits.objects import difference
from app.orbits.parsing import ParsedOrbit, parse_message
from app.orbits.repository import OrbitRepository
from app.outbox.events import Event, attention_changed
from app.outbox.log import append
from app.satellites.repository import SatelliteRepository
from app.satellites.tables import Satellite
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.exclusive import Exclusive
from magcal_core.errors import MagcalError

JITTER: Final = 0.1
"""Requests about one object are up to so much (share) further apart than they may be, so that fleets part."""
BETWEEN_S: Final = (0.2, 1.0)
KEEP_REQUESTS: Final = timedelta(days=30)
PAST_EVERY_H: Final = 2.0
"""A satellite's past is asked for once in so long, h, until there is nothing left to ask for."""

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Asked:
    """What became of one satellite in a round: ``new``, ``known`` (its orbit was there), ``not yet`` or ``failed``.

    ``past`` and ``no past``: elements about sessions of the past have come, or the source has none of them.
    """

    satellite_id: str
    state: str
    why: str | None = None


def stopped(session: Session, source: str) -> ConnectorStop | None:
    """Return why a source must not be asked, None where it may."""
    return session.get(ConnectorStop, source)


def stopped_sources(database: Database) -> list[str]:
    """Return the sources that must not be asked, each with the reason."""
    with database.read() as session:
        rows = session.scalars(select(ConnectorStop).order_by(ConnectorStop.source))
        return [f"{row.source}: {row.reason}" for row in rows]


def start_again(session: Session, source: str) -> bool:
    """Let a source be asked again; return whether it had been stopped."""
    row = stopped(session, source)
    if row is None:
        return False
    session.delete(row)
    session.flush()
    record_event(session, SYSTEM, "orbit_source.start", source)
    append(session, [_attention(source, "started again by a person", is_raised=False)])
    return True


class OrbitWatch:
    """One source, asked for every satellite that has a catalogue number.

    Raises
    ------
    UnavailableError
        The source needs a package that is not installed.
    """

    def __init__(
        self, database: Database, settings: Settings, name: str, pause: Callable[[float], object] = lambda _s: None
    ) -> None:
        self._database = database
        self._settings = settings
        self._name = name
        self._past_ledger = f"{name}-past"
        self._source: OrbitSource = ORBIT_SOURCES[name]
        package = self._source.package
        if package is not None and importlib.util.find_spec(package) is None:
            raise UnavailableError(f"orbits of {name} need the package {package}: install magcal-service[{name}]")
        self._pause = pause
        self._right = Exclusive(database, settings, f"orbits-{name}")

    def release(self) -> None:
        """Leave the source to other processes."""
        self._right.release()

    def round(self) -> list[Asked]:
        """Ask for every satellite whose turn it is; nothing where another process does or the source is stopped."""
        if not self._right.acquire():
            return []
        found: list[Asked] = []
        for watched in self._watched():
            if self._begin(watched, self._name, self._settings.orbit_every_h):
                found += self._ask(watched)
                self._pause(SystemRandom().uniform(*BETWEEN_S))
            else:
                found += [Asked(satellite_id, "not yet") for satellite_id in watched.satellite_ids]
            for satellite_id in watched.satellite_ids:
                found += self._ask_past(watched, satellite_id)
            with self._database.read() as session:
                if stopped(session, self._name) is not None:
                    break
        return found

    def _watched(self) -> list[Watched]:
        """Return every object that has satellites here, in the order of the first satellite of each."""
        found: dict[str, list[str]] = {}
        with self._database.read() as session:
            rows = session.scalars(select(Satellite).where(Satellite.norad_id.is_not(None)).order_by(Satellite.id))
            for row in rows:
                found.setdefault((row.norad_id or "").lstrip("0") or "0", []).append(row.id)
        return [Watched(number, tuple(own)) for number, own in found.items()]

    def _begin(self, watched: Watched, ledger: str, every_h: float) -> bool:
        """Return whether an object may be asked for now, which is written down then."""
        return self._database.transact(lambda session: self._noted(session, watched, ledger, every_h))

    def _noted(self, session: Session, watched: Watched, ledger: str, every_h: float) -> bool:
        now = utc_now()
        if stopped(session, self._name) is not None or not self._may(session, watched, ledger, every_h, now):
            return False
        first, number = watched.satellite_ids[0], watched.catalogue_number
        session.add(
            ConnectorRequest(id=new_id(), source=ledger, satellite_id=first, catalogue_number=number, asked_at=now)
        )
        return True

    def _may(self, session: Session, watched: Watched, ledger: str, every_h: float, now: datetime) -> bool:
        last = session.scalar(
            select(func.max(ConnectorRequest.asked_at)).where(ConnectorRequest.source == ledger, _is_about(watched))
        )
        spread = 1.0 + SystemRandom().uniform(0.0, JITTER)
        if last is not None and now < last + timedelta(hours=every_h * spread):
            return False
        every = ConnectorRequest.source.in_((self._name, self._past_ledger))
        for limit in self._source.limits:
            since = now - timedelta(seconds=limit.within_s)
            recent = select(func.count()).select_from(ConnectorRequest).where(every, ConnectorRequest.asked_at > since)
            if (session.scalar(recent) or 0) >= limit.most:
                return False
        return True

    def _ask(self, watched: Watched) -> list[Asked]:
        answer = self._orbits(lambda: self._source.ask(self._settings, watched))
        kept = [self._kept(satellite_id, answer) for satellite_id in watched.satellite_ids]
        return self._note(watched, self._name, kept)

    def _kept(self, satellite_id: str, answer: list[ParsedOrbit] | str) -> Asked:
        """Return what became of an answer, orbits or why there are none, for one of the satellites."""
        if isinstance(answer, str):
            return Asked(satellite_id, "failed", answer)
        try:
            is_new = self._database.transact(lambda session: _add(session, satellite_id, answer))
        except (SourceContentError, NotFoundError) as error:
            return Asked(satellite_id, "failed", error.message)
        return Asked(satellite_id, "new" if is_new else "known")

    def _ask_past(self, watched: Watched, satellite_id: str) -> list[Asked]:
        """Return what became of the elements about sessions of the past; nothing where none are lacking."""
        source = self._source
        if not isinstance(source, PastSource):
            return []
        with self._database.read() as session:
            span = past.lacking(session, self._name, satellite_id)
        if span is None or not self._begin(watched, self._past_ledger, PAST_EVERY_H):
            return []
        answer = self._orbits(lambda: source.ask_between(self._settings, watched, span.first, span.last))
        self._pause(SystemRandom().uniform(*BETWEEN_S))
        return self._note(watched, self._past_ledger, [self._kept_past(satellite_id, span, answer)])

    def _kept_past(self, satellite_id: str, span: past.Span, answer: list[ParsedOrbit] | str) -> Asked:
        if isinstance(answer, str):
            return Asked(satellite_id, "failed", answer)
        try:
            self._database.transact(lambda session: self._keep_past(session, satellite_id, span, answer))
        except (SourceContentError, NotFoundError) as error:
            return Asked(satellite_id, "failed", error.message)
        return Asked(satellite_id, "past" if answer else "no past")

    def _keep_past(self, session: Session, satellite_id: str, span: past.Span, orbits: list[ParsedOrbit]) -> None:
        if orbits:
            _add(session, satellite_id, orbits)
        past.note(session, self._name, satellite_id, span)

    def _orbits(self, ask: Callable[[], Reply | None]) -> list[ParsedOrbit] | str:
        """Return the orbits of an answer, none where the source has none; or what went wrong."""
        try:
            reply = ask()
            return [] if reply is None else parse_message(reply.body, reply.media_type)
        except SourceAnswerError as error:
            self._stop(error.message)
            return error.message
        except (SourceUnreachableError, SourceContentError) as error:
            return error.message
        except MagcalError as error:
            return f"what it answered cannot be read: {error.code}: {error.message}"

    def _note(self, watched: Watched, ledger: str, found: list[Asked]) -> list[Asked]:
        """Return ``found``, what came of the latest request about an object, once it is written down."""
        outcome = "; ".join(dict.fromkeys(one.why or one.state for one in found))[:500]
        self._database.transact(lambda session: self._write_down(session, watched, ledger, outcome))
        for one in found:
            if one.why is not None:
                log.warning("orbit_not_fetched", source=ledger, satellite=one.satellite_id, why=one.why)
        return found

    def _write_down(self, session: Session, watched: Watched, ledger: str, outcome: str) -> None:
        """Keep what came of the latest request about an object, and forget requests that are old."""
        mine = ConnectorRequest.source == ledger
        own = select(ConnectorRequest).where(mine, _is_about(watched))
        session.scalars(own.order_by(ConnectorRequest.asked_at.desc()).limit(1)).one().outcome = outcome
        old = ConnectorRequest.asked_at < utc_now() - KEEP_REQUESTS
        for row in session.scalars(select(ConnectorRequest).where(old, mine)):
            session.delete(row)

    def _stop(self, reason: str) -> None:
        why = f"{reason}; it is not asked again until you say so: magcal orbits start {self._name}"
        self._database.transact(lambda session: self._stopped(session, why))
        log.error("orbit_source_stopped", source=self._name, why=reason)

    def _stopped(self, session: Session, why: str) -> None:
        session.merge(ConnectorStop(source=self._name, reason=why[:500], stopped_at=utc_now()))
        record_event(session, SYSTEM, "orbit_source.stop", self._name)
        append(session, [_attention(self._name, why, is_raised=True)])


def _is_about(watched: Watched) -> ColumnElement[bool]:
    """Return the condition that tells the requests about an object."""
    row = ConnectorRequest
    return or_(
        row.catalogue_number == watched.catalogue_number,
        row.catalogue_number.is_(None) & row.satellite_id.in_(watched.satellite_ids),
    )


def _add(session: Session, satellite_id: str, orbits: list[ParsedOrbit]) -> bool:
    """Keep those of ``orbits`` that are the satellite's; return whether one of them is new.

    Raises
    ------
    SourceContentError
        All are another object's.
    NotFoundError
        The satellite has been removed.
    """
    satellite = SatelliteRepository(session, SYSTEM).get(satellite_id)
    others = [difference(satellite, one.details) for one in orbits]
    own = [one for one, other in zip(orbits, others, strict=True) if other is None]
    if not own:
        raise SourceContentError(f"the orbits are those of another object than the satellite: {others[0]}")
    return OrbitRepository(session, SYSTEM, satellite_id).add(own)[1]


def _attention(source: str, reason: str, *, is_raised: bool) -> Event:
    return attention_changed(is_raised=is_raised, cause=f"orbit source {source} stopped", reason=reason)

"""Keep every satellite's orbit fresh, with the manners that catalogues ask for.

One request a satellite in `MAGCAL_ORBIT_EVERY_H` hours, whatever is restarted or killed meanwhile: it is written down
before it is sent. Any answer but 200 stops the source until a person starts it again. One process at a time asks.
Where a source has the past, too, the elements about sessions that no orbit is near are fetched, each span once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from random import SystemRandom
from typing import Final

import structlog
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.connectors.http import SourceAnswerError, SourceContentError, SourceUnreachableError
from app.connectors.orbits import past
from app.connectors.orbits.contract import OrbitSource, PastSource, Reply, Watched
from app.connectors.orbits.registry import ORBIT_SOURCES
from app.connectors.tables import ConnectorRequest, ConnectorStop
from app.orbits.parsing import ParsedOrbit, parse_message
from app.orbits.repository import OrbitRepository
from app.outbox.events import Event, attention_changed
from app.outbox.log import append
from app.satellites.tables import Satellite
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.exclusive import Exclusive
from magcal_core.errors import MagcalError

JITTER: Final = 0.1
"""Requests of one satellite are up to so much (share) further apart than they may be, so that fleets part."""
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
    """One source, asked for every satellite that has a catalogue number."""

    def __init__(
        self, database: Database, settings: Settings, name: str, pause: Callable[[float], object] = lambda _s: None
    ) -> None:
        self._database = database
        self._settings = settings
        self._name = name
        self._past_ledger = f"{name}-past"
        self._source: OrbitSource = ORBIT_SOURCES[name]
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
        for satellite in self._satellites():
            if self._begin(satellite, self._name, self._settings.orbit_every_h):
                found.append(self._ask(satellite))
                self._pause(SystemRandom().uniform(*BETWEEN_S))
            else:
                found.append(Asked(satellite.satellite_id, "not yet"))
            found += self._ask_past(satellite)
            with self._database.read() as session:
                if stopped(session, self._name) is not None:
                    break
        return found

    def _satellites(self) -> list[Watched]:
        with self._database.read() as session:
            rows = session.scalars(select(Satellite).where(Satellite.norad_id.is_not(None)).order_by(Satellite.id))
            return [Watched(row.id, row.norad_id, row.cospar_id) for row in rows]

    def _begin(self, satellite: Watched, ledger: str, every_h: float) -> bool:
        """Return whether the satellite may be asked for now, which is written down then."""
        return self._database.transact(lambda session: self._noted(session, satellite, ledger, every_h))

    def _noted(self, session: Session, satellite: Watched, ledger: str, every_h: float) -> bool:
        now = utc_now()
        if stopped(session, self._name) is not None or not self._may(session, satellite, ledger, every_h, now):
            return False
        session.add(ConnectorRequest(id=new_id(), source=ledger, satellite_id=satellite.satellite_id, asked_at=now))
        return True

    def _may(self, session: Session, satellite: Watched, ledger: str, every_h: float, now: datetime) -> bool:
        last = session.scalar(
            select(func.max(ConnectorRequest.asked_at)).where(
                ConnectorRequest.source == ledger, ConnectorRequest.satellite_id == satellite.satellite_id
            )
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

    def _ask(self, satellite: Watched) -> Asked:
        asked = self._orbits(satellite, self._name, lambda: self._source.ask(self._settings, satellite))
        if isinstance(asked, Asked):
            return asked
        of = satellite.satellite_id
        _, is_new = self._database.transact(lambda session: OrbitRepository(session, SYSTEM, of).add(asked))
        return self._note(satellite, self._name, "new" if is_new else "known", None)

    def _ask_past(self, satellite: Watched) -> list[Asked]:
        """Return what became of the elements about sessions of the past; nothing where none are lacking."""
        source = self._source
        if not isinstance(source, PastSource):
            return []
        with self._database.read() as session:
            span = past.lacking(session, self._name, satellite.satellite_id)
        if span is None or not self._begin(satellite, self._past_ledger, PAST_EVERY_H):
            return []
        asked = self._orbits(
            satellite,
            self._past_ledger,
            lambda: source.ask_between(self._settings, satellite, span.first, span.last),
        )
        self._pause(SystemRandom().uniform(*BETWEEN_S))
        if isinstance(asked, Asked):
            return [asked]
        self._database.transact(lambda session: self._keep_past(session, satellite, span, asked))
        return [self._note(satellite, self._past_ledger, "past" if asked else "no past", None)]

    def _keep_past(self, session: Session, satellite: Watched, span: past.Span, orbits: list[ParsedOrbit]) -> None:
        if orbits:
            OrbitRepository(session, SYSTEM, satellite.satellite_id).add(orbits)
        past.note(session, self._name, satellite.satellite_id, span)

    def _orbits(self, satellite: Watched, ledger: str, ask: Callable[[], Reply | None]) -> list[ParsedOrbit] | Asked:
        """Return the satellite's orbits of an answer, none where the source has none; or what went wrong."""
        try:
            reply = ask()
            return [] if reply is None else own_orbits(parse_message(reply.body, reply.media_type), satellite)
        except SourceAnswerError as error:
            self._stop(error.message)
            return self._note(satellite, ledger, "failed", error.message)
        except (SourceUnreachableError, SourceContentError) as error:
            return self._note(satellite, ledger, "failed", error.message)
        except MagcalError as error:
            why = f"what it answered cannot be read: {error.code}: {error.message}"
            return self._note(satellite, ledger, "failed", why)

    def _note(self, satellite: Watched, ledger: str, state: str, why: str | None) -> Asked:
        self._database.transact(lambda session: self._write_down(session, satellite, ledger, (why or state)[:500]))
        if why is not None:
            log.warning("orbit_not_fetched", source=ledger, satellite=satellite.satellite_id, why=why)
        return Asked(satellite.satellite_id, state, why)

    def _write_down(self, session: Session, satellite: Watched, ledger: str, outcome: str) -> None:
        """Keep what came of the latest request for a satellite, and forget requests that are old."""
        mine = ConnectorRequest.source == ledger
        own = select(ConnectorRequest).where(mine, ConnectorRequest.satellite_id == satellite.satellite_id)
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


def own_orbits(orbits: list[ParsedOrbit], satellite: Watched) -> list[ParsedOrbit]:
    """Return those of ``orbits`` that are the satellite's.

    Raises
    ------
    SourceContentError
        There are some, and all are another object's.
    """
    own = [one for one in orbits if _is_own(one, satellite)]
    if not own:
        raise SourceContentError("the orbits are those of another object than the satellite")
    return own


def _is_own(orbit: ParsedOrbit, satellite: Watched) -> bool:
    norad, cospar = orbit.details.get("norad_id"), orbit.details.get("cospar_id")
    if norad is not None and satellite.norad_id is not None:
        return str(norad).lstrip("0") == satellite.norad_id.lstrip("0")
    return cospar is None or satellite.cospar_id is None or cospar == satellite.cospar_id


def _attention(source: str, reason: str, *, is_raised: bool) -> Event:
    return attention_changed(is_raised=is_raised, cause=f"orbit source {source} stopped", reason=reason)

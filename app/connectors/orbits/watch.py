"""Keep every satellite's orbit fresh, with the manners that catalogues ask for.

One request a satellite in `MAGCAL_ORBIT_EVERY_H` hours, whatever is restarted or killed meanwhile: it is written down
before it is sent. Any answer but 200 stops the source until a person starts it again. One process at a time asks.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

import structlog
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.access.audit_trail import record_event
from app.access.caller import SYSTEM
from app.connectors.http import SourceAnswerError, SourceContentError, SourceUnreachableError
from app.connectors.orbits.contract import OrbitSource, Watched
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

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Asked:
    """What became of one satellite in a round: ``new``, ``known`` (its orbit was there), ``not yet`` or ``failed``."""

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
            if not self._begin(satellite):
                found.append(Asked(satellite.satellite_id, "not yet"))
                continue
            found.append(self._ask(satellite))
            with self._database.read() as session:
                if stopped(session, self._name) is not None:
                    break
            self._pause(random.uniform(*BETWEEN_S))  # noqa: S311  spreads requests, guards nothing
        return found

    def _satellites(self) -> list[Watched]:
        with self._database.read() as session:
            rows = session.scalars(select(Satellite).where(Satellite.norad_id.is_not(None)).order_by(Satellite.id))
            return [Watched(row.id, row.norad_id, row.cospar_id) for row in rows]

    def _begin(self, satellite: Watched) -> bool:
        """Return whether the satellite may be asked for now, which is written down then."""
        return self._database.transact(lambda session: self._noted(session, satellite, utc_now()))

    def _noted(self, session: Session, satellite: Watched, now: datetime) -> bool:
        if stopped(session, self._name) is not None or not self._may(session, satellite, now):
            return False
        session.add(ConnectorRequest(id=new_id(), source=self._name, satellite_id=satellite.satellite_id, asked_at=now))
        return True

    def _may(self, session: Session, satellite: Watched, now: datetime) -> bool:
        mine = ConnectorRequest.source == self._name
        last = session.scalar(
            select(func.max(ConnectorRequest.asked_at)).where(
                mine, ConnectorRequest.satellite_id == satellite.satellite_id
            )
        )
        spread = 1.0 + random.uniform(0.0, JITTER)  # noqa: S311  spreads requests, guards nothing
        if last is not None and now < last + timedelta(hours=self._settings.orbit_every_h * spread):
            return False
        for limit in self._source.limits:
            since = now - timedelta(seconds=limit.within_s)
            recent = select(func.count()).select_from(ConnectorRequest).where(mine, ConnectorRequest.asked_at > since)
            if (session.scalar(recent) or 0) >= limit.most:
                return False
        return True

    def _ask(self, satellite: Watched) -> Asked:
        try:
            reply = self._source.ask(self._settings, satellite)
            orbits = own_orbits(parse_message(reply.body, reply.media_type), satellite)
        except SourceAnswerError as error:
            self._stop(error.message)
            return self._note(satellite, "failed", error.message)
        except (SourceUnreachableError, SourceContentError) as error:
            return self._note(satellite, "failed", error.message)
        except MagcalError as error:
            return self._note(satellite, "failed", f"what it answered cannot be read: {error.code}: {error.message}")
        of = satellite.satellite_id
        _, is_new = self._database.transact(lambda session: OrbitRepository(session, SYSTEM, of).add(orbits))
        return self._note(satellite, "new" if is_new else "known", None)

    def _note(self, satellite: Watched, state: str, why: str | None) -> Asked:
        self._database.transact(lambda session: self._write_down(session, satellite, (why or state)[:500]))
        if why is not None:
            log.warning("orbit_not_fetched", source=self._name, satellite=satellite.satellite_id, why=why)
        return Asked(satellite.satellite_id, state, why)

    def _write_down(self, session: Session, satellite: Watched, outcome: str) -> None:
        """Keep what came of the latest request for a satellite, and forget requests that are old."""
        mine = ConnectorRequest.source == self._name
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

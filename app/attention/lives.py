"""Until when each set in force is good: told anew where a magnetometer has another set in force, or a newer one."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Final

import structlog
from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import aliased

from app.attention.entries import Fleet
from app.attention.tables import SetLife
from app.errors import BusyError
from app.monitoring.trends import SHARE, stored_sets, trend_of
from app.parameter_sets.tables import ParameterSet
from app.storage.database import Database
from magcal_core.errors import MagcalError

AT_MOST_S: Final = 1.0
"""Lives are told for so long at once: a trend takes some 0.3 s, and the list waits for nobody's."""

Stale = tuple[str, str, str, str]
"""Satellite, magnetometer, set in force, newest set."""

log = structlog.get_logger()


def tell_lives(database: Database, fleet: Fleet) -> bool:
    """Tell the lives of sets in force that nobody has told yet; return whether some are left for the next time."""
    begun_s = time.monotonic()
    waiting = _stale(database)
    for number, one in enumerate(waiting):
        if number and time.monotonic() - begun_s > AT_MOST_S:
            return True
        _tell(database, one)
        fleet.look_again(one[0])
    return False


def _stale(database: Database) -> list[Stale]:
    active, other, life = ParameterSet, aliased(ParameterSet), SetLife
    newest = (
        select(func.max(other.id))
        .where(other.satellite_id == active.satellite_id, other.magnetometer_id == active.magnetometer_id)
        .correlate(active)
        .scalar_subquery()
    )
    own = and_(life.satellite_id == active.satellite_id, life.magnetometer_id == active.magnetometer_id)
    is_stale = or_(
        life.parameter_set_id.is_(None), life.parameter_set_id != active.id, life.newest_set_id != newest
    )  # fmt: skip
    statement = (
        select(active.satellite_id, active.magnetometer_id, active.id, newest)
        .outerjoin(life, own)
        .where(active.status == "active", is_stale)
        .order_by(active.satellite_id, active.magnetometer_id)
    )
    with database.read() as session:
        return [tuple(row) for row in session.execute(statement)]


def _tell(database: Database, one: Stale) -> None:
    satellite_id, magnetometer_id, active_id, newest_id = one
    try:
        until, is_capped = _life(database, satellite_id, magnetometer_id, active_id)
    except BusyError:  # requests for trends come first
        return
    row = SetLife(
        satellite_id=satellite_id, magnetometer_id=magnetometer_id, parameter_set_id=active_id,
        newest_set_id=newest_id, until=until, share=SHARE, is_capped=is_capped,
    )  # fmt: skip
    with database.write() as session:
        session.merge(row)


def _life(database: Database, satellite_id: str, magnetometer_id: str, active_id: str) -> tuple[datetime | None, bool]:
    """Return until when a set in force is good, None where its trend does not tell: too few sets, or erratic ones."""
    with database.read() as session:
        sets = stored_sets(session, satellite_id, magnetometer_id)
    try:
        life = trend_of(sets).life()
    except BusyError:
        raise
    except MagcalError as error:
        log.debug("no_life", satellite=satellite_id, magnetometer=magnetometer_id, code=error.code)
        return None, False
    if life.until is None or life.parameter_set_id != active_id:
        return None, False
    return datetime.fromisoformat(life.until), life.is_capped

"""Who may touch the objects of a satellite: many may put some at once, whoever removes some is alone.

Objects are named by their bytes, so two sessions may name one object. Whoever puts an object holds its satellite for
the transaction; whoever removes objects takes the satellite, looks once more whether a row names them, and then removes
them. SQLite, where a writing transaction is alone in any case, leaves the locks out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from sqlalchemy import column, select, table
from sqlalchemy.orm import Session

from app.errors import NotFoundError

SATELLITES: Final = table("satellite", column("id"))


def hold_objects(session: Session, satellite_ids: Iterable[str]) -> None:
    """Hold the objects of satellites for the transaction, which is about to put some.

    Raises
    ------
    NotFoundError
        A satellite has been removed meanwhile.
    """
    wanted = sorted(set(satellite_ids))
    held = select(SATELLITES.c.id).where(SATELLITES.c.id.in_(wanted)).order_by(SATELLITES.c.id)
    if len(session.execute(held.with_for_update(read=True, key_share=True)).all()) != len(wanted):
        raise NotFoundError("no such satellite")


def take_objects(session: Session, satellite_id: str) -> None:
    """Take the objects of a satellite for the transaction, which is about to remove some; wait for who holds them."""
    session.execute(select(SATELLITES.c.id).where(SATELLITES.c.id == satellite_id).with_for_update()).all()

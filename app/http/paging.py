"""Lists in parts: a cursor holds the sort keys of the last item, so that new rows do not shift the parts."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Sequence
from datetime import datetime
from typing import Generic, NamedTuple, TypeVar, TypeVarTuple

from sqlalchemy import ColumnElement, Select, func, or_, select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.http.schemas import PageQuery, utc_text
from magcal_core.errors import InputError

Row = TypeVar("Row")
Columns = TypeVarTuple("Columns")


class CursorError(InputError):
    """A cursor that this service did not give."""

    code = "cursor"


class Part(NamedTuple, Generic[Row]):
    """A part of a list, the cursor of the next one, and how many rows all have together, where that was asked."""

    rows: list[Row]
    cursor: str | None
    total: int | None


def fetch_page(
    session: Session,
    statement: Select[Row],
    keys: Sequence[InstrumentedAttribute[object]],
    query: PageQuery,
    *,
    is_up: bool = False,
) -> Part[Row]:
    """Return one part of ``statement``, the greatest ``keys`` first unless ``is_up``."""
    rows, cursor = cut(list(session.scalars(part_of(statement, keys, query, is_up=is_up))), keys, query)
    total = session.scalar(select(func.count()).select_from(statement.subquery())) or 0 if query.total else None
    return Part(rows, cursor, total)


def part_of(
    statement: Select[*Columns],
    keys: Sequence[InstrumentedAttribute[object]],
    query: PageQuery,
    *,
    is_up: bool = False,
) -> Select[*Columns]:
    """Return the statement of one part, the greatest ``keys`` first unless ``is_up``, and of one row more, if any."""
    if query.cursor is not None:
        last = tuple_(*_decode(query.cursor, keys))
        statement = statement.where(tuple_(*keys) > last if is_up else tuple_(*keys) < last)
    return statement.order_by(*(key.asc() if is_up else key.desc() for key in keys)).limit(query.limit + 1)


def has_part(
    wanted: str, *columns: InstrumentedAttribute[str] | InstrumentedAttribute[str | None]
) -> ColumnElement[bool]:
    """Return the condition that one of ``columns`` has ``wanted`` in it, upper and lower case alike."""
    return or_(*(func.lower(column).contains(wanted.lower(), autoescape=True) for column in columns))


def cut(
    rows: list[Row], keys: Sequence[InstrumentedAttribute[object]], query: PageQuery
) -> tuple[list[Row], str | None]:
    """Return the rows of `part_of` that are in the part, and the cursor of the next part."""
    if len(rows) <= query.limit:
        return rows, None
    last = rows[query.limit - 1]
    return rows[: query.limit], _encode([getattr(last, key.key) for key in keys])


def _encode(values: Sequence[object]) -> str:
    plain = [utc_text(value) if isinstance(value, datetime) else value for value in values]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def _decode(cursor: str, keys: Sequence[InstrumentedAttribute[object]]) -> list[object]:
    try:
        padded = cursor + "=" * (-len(cursor) % 4)
        values = json.loads(base64.b64decode(padded.encode("ascii"), altchars=b"-_", validate=True))
        if not isinstance(values, list) or len(values) != len(keys):
            raise ValueError("wrong number of keys")
        return [_typed(value, key) for value, key in zip(values, keys, strict=True)]
    except (ValueError, binascii.Error, RecursionError):
        raise CursorError("the cursor is not one that this service gave") from None


def _typed(value: object, key: InstrumentedAttribute[object]) -> object:
    wanted = key.type.python_type
    if wanted is datetime and isinstance(value, str):
        time = datetime.fromisoformat(value)
        if time.tzinfo is None:
            raise ValueError("no zone")
        return time
    if type(value) is not wanted or (isinstance(value, str) and "\0" in value):
        raise ValueError("wrong type")
    return value

"""Lists in parts: a cursor holds the sort keys of the last item, so that new rows do not shift the parts."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Sequence
from datetime import datetime
from typing import TypeVar, TypeVarTuple

from sqlalchemy import Select, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.http.schemas import PageQuery, utc_text
from magcal_core.errors import InputError

Row = TypeVar("Row")
Columns = TypeVarTuple("Columns")


class CursorError(InputError):
    """A cursor that this service did not give."""

    code = "cursor"


def fetch_page(
    session: Session, statement: Select[Row], keys: Sequence[InstrumentedAttribute[object]], query: PageQuery
) -> tuple[list[Row], str | None]:
    """Return the rows of one part, the greatest ``keys`` first, and the cursor of the next part."""
    return cut(list(session.scalars(part_of(statement, keys, query))), keys, query)


def part_of(
    statement: Select[*Columns], keys: Sequence[InstrumentedAttribute[object]], query: PageQuery
) -> Select[*Columns]:
    """Return the statement of one part, the greatest ``keys`` first, and of one row more, if there is one."""
    if query.cursor is not None:
        statement = statement.where(tuple_(*keys) < tuple_(*_decode(query.cursor, keys)))
    return statement.order_by(*(key.desc() for key in keys)).limit(query.limit + 1)


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

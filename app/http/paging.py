"""Lists in parts: a cursor holds the sort keys of the last item, so that new rows do not shift the parts."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Generic, NamedTuple, TypeVar, TypeVarTuple

from fastapi import Response
from pydantic import BaseModel
from sqlalchemy import ColumnElement, Select, func, or_, select, true, tuple_
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.http.schemas import Page, PageQuery, utc_text
from magcal_core.errors import InputError

Row = TypeVar("Row")
Columns = TypeVarTuple("Columns")
Full = TypeVar("Full", bound=BaseModel)
Short = TypeVar("Short", bound=BaseModel)
Text = InstrumentedAttribute[str] | InstrumentedAttribute[str | None] | ColumnElement[str]
Keys = Sequence[InstrumentedAttribute[Any]]


class CursorError(InputError):
    """A cursor that this service did not give."""

    code = "cursor"


class Part(NamedTuple, Generic[Row]):
    """A part of a list, the cursor of the next one, and how many rows all have together, where that was asked."""

    rows: list[Row]
    cursor: str | None
    total: int | None


@dataclass(frozen=True, slots=True)
class Ways:
    """How a list is gone through: by the columns of each of its orders, the last of which tell rows apart.

    ``searched`` is what `q` looks in.
    """

    orders: Mapping[str, Keys]
    searched: Sequence[Text]

    def keys(self, query: PageQuery) -> Keys:
        """Return the columns of the order that ``query`` asks for, either way round."""
        return self.orders[query.sort.removeprefix("-")]

    def holding(self, query: PageQuery) -> ColumnElement[bool]:
        """Return the condition that a row has what ``query`` searches for."""
        return true() if query.q is None else has_part(query.q, *self.searched)


def fetch_page(session: Session, statement: Select[Row], ways: Ways, query: PageQuery) -> Part[Row]:
    """Return one part of those rows of ``statement`` that ``query`` searches for, in the order that it asks for."""
    found = statement.where(ways.holding(query))
    rows, cursor = cut(list(session.scalars(part_of(found, ways, query))), ways, query)
    total = session.scalar(select(func.count()).select_from(found.subquery())) or 0 if query.total else None
    return Part(rows, cursor, total)


def part_of(statement: Select[*Columns], ways: Ways, query: PageQuery) -> Select[*Columns]:
    """Return the statement of one part, in the order that ``query`` asks for, and of one row more, if any."""
    keys, is_up = ways.keys(query), not query.sort.startswith("-")
    if query.cursor is not None:
        last = tuple_(*_decode(query.cursor, keys))
        statement = statement.where(tuple_(*keys) > last if is_up else tuple_(*keys) < last)
    return statement.order_by(*(key.asc() if is_up else key.desc() for key in keys)).limit(query.limit + 1)


def has_part(wanted: str, *columns: Text) -> ColumnElement[bool]:
    """Return the condition that one of ``columns`` has ``wanted`` in it, upper and lower case alike."""
    return or_(*(func.lower(column).contains(wanted.lower(), autoescape=True) for column in columns))


def cut(rows: list[Row], ways: Ways, query: PageQuery) -> tuple[list[Row], str | None]:
    """Return the rows of `part_of` that are in the part, and the cursor of the next part."""
    if len(rows) <= query.limit:
        return rows, None
    last = rows[query.limit - 1]
    return rows[: query.limit], _encode([getattr(last, key.key) for key in ways.keys(query)])


def page_of(items: Sequence[Full], part: Part[Row], query: PageQuery, short: type[Short]) -> Page[Full] | Page[Short]:
    """Return a part of a list as it is answered: its items whole, or as ``short``, which has some of their fields."""
    if query.view == "full":
        return Page(items=list(items), next=part.cursor, total=part.total)
    return Page(items=[in_short(one, short) for one in items], next=part.cursor, total=part.total)


def in_short(item: BaseModel, short: type[Short]) -> Short:
    """Return what ``short`` has of ``item``."""
    return short.model_construct(**{name: getattr(item, name) for name in short.model_fields})


def answered(page: BaseModel) -> Response:
    """Return the answer of a list, whose items have been checked already."""
    return Response(page.model_dump_json(), media_type="application/json")


def _encode(values: Sequence[object]) -> str:
    plain = [utc_text(value) if isinstance(value, datetime) else value for value in values]
    return base64.urlsafe_b64encode(json.dumps(plain).encode()).decode().rstrip("=")


def _decode(cursor: str, keys: Keys) -> list[object]:
    try:
        padded = cursor + "=" * (-len(cursor) % 4)
        values = json.loads(base64.b64decode(padded.encode("ascii"), altchars=b"-_", validate=True))
        if not isinstance(values, list) or len(values) != len(keys):
            raise ValueError("wrong number of keys")
        return [_typed(value, key) for value, key in zip(values, keys, strict=True)]
    except (ValueError, binascii.Error, RecursionError):
        raise CursorError("the cursor is not one that this service gave") from None


def _typed(value: object, key: InstrumentedAttribute[Any]) -> object:
    wanted = key.type.python_type
    if wanted is datetime and isinstance(value, str):
        time = datetime.fromisoformat(value)
        if time.tzinfo is None:
            raise ValueError("no zone")
        return time
    if type(value) is not wanted or (isinstance(value, str) and "\0" in value):
        raise ValueError("wrong type")
    return value

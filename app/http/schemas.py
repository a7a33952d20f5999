"""What the bodies of every room share: strictness, times, names, lists with a cursor."""

from __future__ import annotations

import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Final, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainSerializer,
    StringConstraints,
    WithJsonSchema,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, PydanticKnownError, core_schema

MAX_NAME: Final = 200
CORE_TIMES: Final = (np.datetime64("1678-01-01", "us"), np.datetime64("2262-01-01", "us"))
Item = TypeVar("Item")


class Body(BaseModel):
    """Base of what clients send: nothing unknown, no conversions, no NaN."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class Filter(BaseModel):
    """Base of query strings: nothing unknown."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Record(BaseModel):
    """Base of what the service answers."""

    model_config = ConfigDict(from_attributes=True, extra="forbid")


def utc_text(time: datetime) -> str:
    """Return ``time`` in ISO 8601 with ``Z`` and microseconds."""
    return time.astimezone(UTC).replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"


def day_text(time: datetime) -> str:
    """Return a day as a person reads it, such as 29 Nov 2026."""
    return f"{time.day} {time:%b %Y}"


def core_times(times: Sequence[datetime]) -> NDArray[np.datetime64]:
    """Return ``times``, which are in UTC, as the core has them, to the nanosecond: those beyond its years at their end.

    numpy alone takes a year that nanoseconds do not reach for another one, centuries away, and says nothing.
    """
    t_utc = np.array([time.replace(tzinfo=None) for time in times], "datetime64[us]")
    return np.asarray(np.clip(t_utc, *CORE_TIMES), "datetime64[ns]")


def parse_utc(value: object) -> object:
    """Return the time that a text means, in UTC; a text without a zone is refused."""
    if not isinstance(value, str):
        return value
    try:
        time = datetime.fromisoformat(value)
    except ValueError:
        raise PydanticCustomError("time", "want a time in ISO 8601, such as 2026-11-22T10:00:00Z") from None
    if time.tzinfo is None:
        raise PydanticCustomError("time_zone_missing", "the time has no zone; append Z for UTC")
    try:
        return time.astimezone(UTC)
    except OverflowError:
        raise PydanticCustomError("time", "the time is out of range") from None


def _clean_text(value: str) -> str:
    text = unicodedata.normalize("NFC", value)
    if any(unicodedata.category(c) in {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"} for c in text):
        raise PydanticCustomError("control_character", "control and format characters are not allowed")
    return text


@dataclass(frozen=True, slots=True, eq=False)
class OneOf:
    """Annotation of a text that is one of ``names``: those of a registry, so that a name is written down once.

    Requests, the schema and messages know it as if it were a ``Literal`` of these names.
    """

    names: Collection[str]

    def __get_pydantic_core_schema__(self, source: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of a text that is checked afterwards."""
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the schema with the names that there are."""
        return {**handler(schema), "enum": list(self.names)}

    def _checked(self, text: str) -> str:
        if text in self.names:
            return text
        *first, last = map(repr, self.names)
        raise PydanticKnownError("literal_error", {"expected": f"{', '.join(first)} or {last}" if first else last})


UtcTime = Annotated[
    datetime,
    BeforeValidator(parse_utc),
    PlainSerializer(utc_text, return_type=str),
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
Name = Annotated[str, StringConstraints(min_length=1, max_length=MAX_NAME), AfterValidator(_clean_text)]
Slug = Annotated[str, StringConstraints(pattern=r"^[a-z0-9][a-z0-9._-]{0,62}$")]
"""Name of a satellite or magnetometer in addresses: lower case, digits, dot, dash, underscore."""


Search = Annotated[str, StringConstraints(min_length=1, max_length=200), AfterValidator(_clean_text)]
"""Part of a name or an id that a list is searched for."""


View = Literal["full", "summary"]


class PageQuery(Filter):
    """Which part of a list, in which order; each list names its orders, and what `q` looks in."""

    limit: int = Field(100, ge=1, le=1000, description="Most items in the answer.")
    cursor: str | None = Field(None, max_length=1000, description="`next` of the answer before.")
    total: bool = Field(False, description="With how many there are in all parts together.")
    q: Search | None = Field(None, description="Part of a text of the items.")
    sort: str = Field(description="`-` turns the order round.")
    view: View = Field("full", description="`summary`: each item in under 500 bytes.")


class NewestFirst(PageQuery):
    """Which part of a list that is in the order in which its items were made."""

    sort: Literal["created", "-created"] = Field("-created", description="`-created`: the newest first.")


class Page(BaseModel, Generic[Item]):
    """A part of a list; `next` is the cursor of the following part, `total` the count of all parts where asked for."""

    items: list[Item]
    next: str | None = None
    total: int | None = Field(None, exclude_if=lambda value: value is None)


Identifier = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]

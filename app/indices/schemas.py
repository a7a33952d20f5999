"""Bodies of the calls for indices and files of coefficients."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.http.schemas import Filter, Name, NewestFirst, PageQuery, Record, Search, UtcTime


class IndexRead(Record):
    """One index file."""

    id: str
    name: Literal["RC", "Dst", "Kp"]
    format: str
    sha256: str
    rows: int = Field(description="Intervals that the file has.")
    missing: int = Field(description="Intervals among them without a value.")
    first: UtcTime = Field(description="Start of the first interval.")
    last: UtcTime = Field(description="End of the last interval.")
    created_at: UtcTime


class IndexQuery(PageQuery):
    """Which index files to list."""

    name: Literal["RC", "Dst", "Kp"] | None = None
    at: UtcTime | None = Field(None, description="Only those that reach over this time.")
    q: Search | None = Field(None, description="Part of an id, name, format or SHA-256.")
    sort: Literal["created", "-created", "first", "-first"] = Field(
        "-created", description="`-created`: the newest first; `first` is the start of the first interval."
    )


class FieldFileQuery(NewestFirst):
    """Which files of coefficients to list."""

    q: Search | None = Field(None, description="Part of an id, name or SHA-256.")


class FieldFileShort(Record):
    """One file of coefficients in under 500 bytes."""

    id: str
    name: str | None
    format: str
    created_at: UtcTime


class FieldFileRead(FieldFileShort):
    """One file of coefficients."""

    model: str | None
    sha256: str
    degrees: list[int] = Field(description="The first and the last.")
    order: int = Field(description="Order of the polynomials in time: 1 constants, 2 lines.")
    valid_from: str | None
    valid_until: str | None


class FieldFileUpload(Filter):
    """What is said of a file of coefficients beside its bytes."""

    name: Name | None = Field(None, description="What records call the file.")

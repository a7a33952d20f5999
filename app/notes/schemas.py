"""Bodies of the notes' calls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from app.http.schemas import Body, NewestFirst, Record, Search, UtcTime

Kind = Literal["satellite", "magnetometer", "session", "parameter_set"]


class NoteCreate(Body):
    """What somebody writes beside a thing."""

    text: Annotated[str, StringConstraints(min_length=1, max_length=4000, strip_whitespace=True)] = Field(
        description="Plain text, line breaks kept."
    )


class NoteQuery(NewestFirst):
    """Which notes to list."""

    q: Search | None = Field(None, description="Part of the text.")


class NoteShort(Record):
    """A note without its text, in under 500 bytes."""

    id: str
    kind: Kind = Field(description="What the note stands beside.")
    subject: str = Field(description="Its id; of a magnetometer `satellite/magnetometer`.")
    satellite: str
    created_at: UtcTime
    created_by: str | None = Field(description="Id of the author's key.")
    author: str | None = Field(description="Name of the author's key.")


class NoteRead(NoteShort):
    """A note with its author and time; notes are never changed."""

    text: str

"""Bodies of the calls about what flies."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.aboard.reading import READERS
from app.http.schemas import Body, NewestFirst, OneOf, Record, Search, UtcTime

Form = Annotated[str, OneOf(READERS)]


class AboardBody(Body):
    """What was read back from the flight computer, or how far the parameter set has come."""

    format: Form | None = None
    content: str | None = Field(None, min_length=1, max_length=1 << 18)
    convention: str | None = Field(None, max_length=32, description="Where the content does not name it; else `exact`.")
    first_id: int = Field(0, ge=0, le=0xFFFF_FF00, description="`fprime-dat`, in base64: the id of MGM_OFFSET.")
    state: Literal["exported", "uploaded"] | None = None

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        is_read_back = self.format is not None and self.content is not None
        if (self.format is None) != (self.content is None) or is_read_back == (self.state is not None):
            raise PydanticCustomError("aboard", "want format and content, or state")
        return self


class DifferenceRead(Record):
    """A number that is not aboard as it was exported, and what that alone changes of the corrected field at most."""

    name: str
    exported: float
    aboard: float
    effect_nt: float | None = Field(description="At a field of 45,000 nT; null: it is no sensor's table any more.")
    effect_deg: float | None


class AboardQuery(NewestFirst):
    """Which reports to list."""

    q: Search | None = Field(None, description="Part of a state, or of the id of the key that made the report.")


class AboardShort(Record):
    """How what is aboard stands to the parameter set, without the numbers, in under 500 bytes."""

    state: Literal["exported", "uploaded", "confirmed", "rounded", "different"]
    effect_nt: float | None = Field(description="On the corrected field, of all differences together, nT.")
    effect_deg: float | None
    matches_parameter_set_id: str | None = Field(description="Another set of the magnetometer that it is instead.")
    created_at: UtcTime
    created_by: str | None


class AboardRead(AboardShort):
    """How what is aboard stands to the parameter set."""

    differences: list[DifferenceRead]

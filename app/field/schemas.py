"""Bodies of the reference field's call."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.http.schemas import Body, Identifier, Record, UtcTime
from app.records.calibration_options import FieldName, IndexGap

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Position = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
MOST_POINTS = 100_000


class FieldRequest(Body):
    """Where and when, and by which model."""

    time: list[UtcTime] = Field(min_length=1, max_length=MOST_POINTS)
    position_km: list[Position] = Field(min_length=1, max_length=MOST_POINTS)
    frame: Literal["ITRF", "GCRF", "TEME"] = "ITRF"
    model: FieldName = "igrf"
    max_degree: int | None = Field(None, ge=1, le=250)
    field_file: Identifier | None = Field(None, description="Coefficients, for a model with `file`.")
    index_gap: IndexGap = Field("refuse", description="Where the index has no value.")

    @model_validator(mode="after")
    def _same_length(self) -> Self:
        if len(self.time) != len(self.position_km):
            raise PydanticCustomError("length", "time and position_km have different lengths")
        return self


class FieldRead(Record):
    """The reference field in the frame that was asked for."""

    model: str
    frame: str
    field_nt: list[list[float]]
    magnitude_nt: list[float]

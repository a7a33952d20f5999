"""Bodies of the jobs' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.http.schemas import Body, Identifier, NewestFirst, Page, Record, Search, Slug, UtcTime
from app.records.calibration_options import CalibrationOptionsBody

JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]


class JobBody(Body):
    """What every kind of job takes."""

    kind: str
    priority: int = Field(0, ge=-100, le=100, description="The greater, the sooner.")


class CalibrationBody(JobBody, CalibrationOptionsBody):
    """Calibrate one magnetometer from one or more of its sessions."""

    kind: Literal["calibration"]
    session_ids: list[Identifier] = Field(min_length=1, max_length=1000)
    field_file: Identifier | None = Field(None, description="Coefficients, for a field with `file`.")
    candidate_orbits: list[Identifier] | None = Field(
        None,
        max_length=1000,
        description="Orbits that a diagnosis tries where the calibration fails. Unset: all near ones in reach.",
    )


class ReprocessingBody(CalibrationOptionsBody):
    """Calibrate a whole history anew: one job for each closed session that fits, under one job that sums them up."""

    satellites: list[Slug] | None = Field(None, min_length=1, max_length=10_000, description="Unset: all in reach.")
    magnetometer: Slug | None = None
    since: UtcTime | None = None
    until: UtcTime | None = None
    field_file: Identifier | None = Field(None, description="Coefficients, for a field with `file`.")
    priority: int = Field(-50, ge=-100, le=100, description="Below 0, so that a pass goes first.")


class JobShort(Record):
    """A job in under 500 bytes."""

    id: str
    kind: str
    state: JobState
    progress: float
    satellite: str | None
    magnetometer: str | None
    verdict: Literal["accept", "weak", "refuse"] | None = Field(None, description="Of the set that it made.")
    created_at: UtcTime
    started_at: UtcTime | None
    finished_at: UtcTime | None


class JobRead(JobShort):
    """A job as it stands."""

    attempts: int
    worker: str | None = Field(description="HOST:PID of the worker that has it, or had it last.")
    priority: int
    session_ids: list[str]
    parent_id: str | None
    options: dict[str, JsonValue] = Field(
        description="What it was asked for, resolved; `POST /jobs/{job_id}/retry` asks for it again."
    )
    error: dict[str, JsonValue] | None
    result: dict[str, JsonValue] | None
    cancel_requested: bool
    created_by: str | None


class JobQuery(NewestFirst):
    """Which jobs to list."""

    state: JobState | None = None
    kind: str | None = Field(None, max_length=32)
    satellite: Slug | None = None
    magnetometer: Slug | None = None
    session: Identifier | None = None
    parent: Identifier | None = None
    q: Search | None = Field(None, description="Part of an id of the job, its satellite, magnetometer or kind.")


class JobPage(Page[JobRead]):
    """A part of the jobs; with `total`, how many there are of each state, whichever state is asked for."""

    counts: dict[str, int] | None = Field(None, exclude_if=lambda value: value is None)


class JobShortPage(Page[JobShort]):
    """A part of the jobs in short; with `total`, how many there are of each state, whichever state is asked for."""

    counts: dict[str, int] | None = Field(None, exclude_if=lambda value: value is None)

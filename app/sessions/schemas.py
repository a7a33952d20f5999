"""Bodies of the sessions' calls."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from app.http.schemas import Filter, PageQuery, Record, Search, Slug, UtcTime
from app.http.tables import TableFormat


class ChunkRead(Record):
    """Bytes as they arrived."""

    sequence: int
    sha256: str
    size_bytes: int
    format: str
    samples: int
    created_at: UtcTime


class AgreementRead(Record):
    """Whether a session agrees with the parameter set that was in force when it was judged last."""

    parameter_set_id: str
    grade: Literal["agrees", "watch", "disagrees", "too_short", "not_judged"]
    reasons: list[str]
    residual_rms_nt: float | None = Field(description="Residual of |B| under that set, nT.")
    residual_ratio: float | None = Field(description="Over the residual of that set on its own data.")
    judged_at: UtcTime


class SessionShort(Record):
    """A session in under 500 bytes."""

    id: str
    satellite: str
    magnetometer: str
    state: Literal["open", "closed"]
    samples: int
    used_samples: int
    data_from: UtcTime | None
    data_until: UtcTime | None
    created_at: UtcTime


class SessionRead(SessionShort):
    """A session as it stands."""

    sha256: str | None
    size_bytes: int
    columns: list[str]
    quality: dict[str, JsonValue]
    raw_removed_at: UtcTime | None
    created_by: str | None
    closed_at: UtcTime | None
    monitoring: AgreementRead | None = Field(
        None, description="Against the set in force: made when the session arrives and when a set is activated."
    )
    job_id: str | None = Field(None, description="The job that the magnetometer's policy queued for this session.")


class SessionDetail(SessionRead):
    """A session with the bytes that it came in."""

    chunks: list[ChunkRead]


class ChunkQuery(Filter):
    """How a chunk is read."""

    time_epoch: UtcTime | None = Field(None, description="Instant that times in seconds since boot count from.")

    @property
    def epoch_text(self) -> str | None:
        """The epoch as the core reads it."""
        return None if self.time_epoch is None else self.time_epoch.isoformat()


class UploadQuery(ChunkQuery):
    """Where an upload belongs."""

    magnetometer: Slug
    open: bool = Field(False, description="Leave the session open for further chunks.")


class SessionQuery(PageQuery):
    """Which sessions to list."""

    satellite: Slug | None = None
    magnetometer: Slug | None = None
    state: Literal["open", "closed"] | None = None
    sha256: str | None = Field(None, pattern="^[0-9a-f]{64}$")
    since: UtcTime | None = None
    until: UtcTime | None = None
    q: Search | None = Field(None, description="Part of an id of the session, its satellite or magnetometer.")
    sort: Literal["arrived", "-arrived"] = Field("-arrived", description="`-arrived`: the newest first.")
    agreement: Literal["agrees", "watch", "disagrees", "too_short", "not_judged"] | None = Field(
        None, description="With the set in force, as judged last."
    )


class SampleQuery(Filter):
    """Which samples, and how."""

    since: UtcTime | None = None
    until: UtcTime | None = None
    flags: bool = Field(False, description="Add the column magcal_flags.")
    format: TableFormat | None = Field(None, description="Instead of Accept.")

"""Settings: read once from the environment (``MAGCAL_...``), typed, with their units."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Everything that an operator may set; `docs/configuration.md` says more of each."""

    model_config = SettingsConfigDict(env_prefix="MAGCAL_", frozen=True, extra="ignore")

    database_url: str | None = Field(None, description="SQLAlchemy URL; unset: SQLite in the data folder.")
    data_dir: Path = Field(Path("magcal-data"), description="Folder of the database and of uploads on their way.")
    store_url: str | None = Field(None, description="Where raw bytes and chunks go; unset: the database.")

    host: str = Field("127.0.0.1", description="Address that the API listens on.")
    port: int = Field(8000, ge=0, le=65535, description="Port that the API listens on; 0 takes a free one.")
    workers: NonNegativeInt = Field(
        default_factory=lambda: min(4, os.cpu_count() or 1), description="Job workers of one process."
    )

    max_upload_mb: PositiveInt = Field(100, description="Largest body of an upload, MB (1e6 bytes).")
    max_decompressed_mb: PositiveInt = Field(512, description="Largest decompressed upload, MiB (2**20 bytes).")
    max_rows: PositiveInt = Field(2_000_000, description="Most rows of one upload.")
    max_uploads_at_once: PositiveInt = Field(64, description="Uploads in flight; more are answered 503.")
    max_uploads_per_key: PositiveInt = Field(32, description="Uploads in flight of one key; more are answered 429.")
    max_mb_per_day: PositiveInt | None = Field(
        None, description="Telemetry of one key in 24 hours, MB (1e6 bytes); unset: no limit."
    )
    upload_stall_s: PositiveFloat = Field(30.0, description="Cut an upload that makes no progress for so long, s.")
    min_free_mb: NonNegativeInt = Field(1024, description="Refuse uploads where the disk has less free, MiB.")
    max_bad_samples: float = Field(0.5, ge=0, le=1, description="Refuse telemetry with more flagged samples (share).")

    job_timeout_s: PositiveFloat = Field(600.0, description="Kill a job's calculation after so long, s.")
    job_memory_mb: PositiveInt = Field(4096, description="Address space of a job's calculation, MiB.")
    job_attempts: PositiveInt = Field(3, description="Attempts of a job whose worker is lost, before it is dead.")
    job_heartbeat_s: PositiveFloat = Field(3.0, description="A worker renews the lease of its job so often, s.")
    job_lease_s: PositiveFloat = Field(10.0, description="A job is taken up by another worker after so long, s.")
    job_poll_s: PositiveFloat = Field(0.25, description="A worker looks for jobs of other processes so often, s.")

    max_queued_jobs: PositiveInt = Field(20_000, description="Most jobs that wait, per key.")
    auth_failures_per_minute: PositiveInt = Field(20, description="Wrong keys per address and key id, per minute.")
    oidc_issuer: str | None = Field(None, description="OpenID Connect issuer whose tokens are taken; unset: none.")
    oidc_audience: str | None = Field(None, description="Audience (`aud`) that its tokens must be for.")
    oidc_scope_claim: str = Field("magcal_scopes", description="Claim of a token that names its scopes.")
    oidc_satellite_claim: str = Field(
        "magcal_satellites", description="Claim of a token that names its satellites; only `*` means all."
    )
    login_hours: PositiveFloat = Field(12.0, description="Life of a dashboard login, h.")

    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least level that is logged.")
    log_format: Literal["json", "console"] = Field("json", description="Form of the log on stderr.")

    @property
    def url(self) -> str:
        """The database's SQLAlchemy URL, with its driver."""
        if self.database_url is None:
            return f"sqlite:///{(self.data_dir / 'magcal.db').absolute()}"
        scheme, _, rest = self.database_url.partition("://")
        return f"postgresql+psycopg://{rest}" if scheme in {"postgres", "postgresql"} else self.database_url

    @property
    def is_postgres(self) -> bool:
        """Whether the database is PostgreSQL."""
        return self.url.startswith("postgresql")

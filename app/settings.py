"""Settings: read once from the environment (``MAGCAL_...``), typed, with their units."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict
from pydantic_settings import SettingsError as SourceError

from magcal_core.errors import MagcalError

PREFIX: Final = "MAGCAL_"


class SettingsError(MagcalError):
    """A setting has a value that it cannot have."""

    code = "setting"


class Settings(BaseSettings):
    """Everything that an operator may set; `docs/configuration.md` says more of each."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, frozen=True, extra="ignore")

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
    request_timeout_s: PositiveFloat = Field(
        10.0, description="Close a connection whose request head or JSON body does not come within so long, s."
    )
    max_connections: PositiveInt = Field(
        2000, description="Connections at once; more are answered 503, fewer where the system allows fewer files."
    )
    min_free_mb: NonNegativeInt = Field(1024, description="Refuse uploads where the disk has less free, MiB.")
    max_bad_samples: float = Field(0.5, ge=0, le=1, description="Refuse telemetry with more flagged samples (share).")

    job_timeout_s: PositiveFloat = Field(600.0, description="Kill a job's calculation after so long, s.")
    job_memory_mb: PositiveInt = Field(4096, description="Address space of a job's calculation, MiB.")
    job_attempts: PositiveInt = Field(3, description="Attempts of a job whose worker is lost, before it is dead.")
    job_heartbeat_s: PositiveFloat = Field(3.0, description="A worker renews the lease of its job so often, s.")
    job_lease_s: PositiveFloat = Field(10.0, description="A job is taken up by another worker after so long, s.")
    job_poll_s: PositiveFloat = Field(0.25, description="A worker looks for jobs of other processes so often, s.")

    cors_origins: str = Field(
        "",
        pattern=r"^\s*(https?://[A-Za-z0-9.:\[\]-]+/?\s*(,\s*https?://[A-Za-z0-9.:\[\]-]+/?\s*)*)?$",
        description="Origins whose pages may call the API, comma-separated; empty: none.",
    )
    metrics_magnetometers: NonNegativeInt = Field(
        1000, description="Most magnetometers that `/metrics` tells of one by one, the worst first."
    )
    max_queued_jobs: PositiveInt = Field(20_000, description="Most jobs that wait, per key.")
    auth_failures_per_minute: PositiveInt = Field(20, description="Wrong keys per address and key id, per minute.")
    oidc_issuer: str | None = Field(None, description="OpenID Connect issuer whose tokens are taken; unset: none.")
    oidc_audience: str | None = Field(None, description="Audience (`aud`) that its tokens must be for.")
    oidc_scope_claim: str = Field("magcal_scopes", description="Claim of a token that names its scopes.")
    oidc_satellite_claim: str = Field(
        "magcal_satellites", description="Claim of a token that names its satellites; only `*` means all."
    )
    login_hours: PositiveFloat = Field(12.0, description="Life of a dashboard login, h.")

    event_days: PositiveFloat = Field(30.0, description="What happened, and deliveries, are kept so long, days.")
    webhook_hosts: str = Field(
        "", description="Hosts, addresses and networks that webhooks may go to, comma-separated; empty: none."
    )
    webhook_retry_hours: PositiveFloat = Field(24.0, description="Try a delivery again for so long, then park it, h.")
    notify_urls: str = Field("", description="Apprise URLs of people to tell, separated by spaces; empty: none.")
    notify_quiet: str | None = Field(
        None, pattern=r"^([01]\d|2[0-3]):[0-5]\d-([01]\d|2[0-3]):[0-5]\d$",
        description="Hours in which no message goes out, UTC, such as 22:00-06:00.",
    )  # fmt: skip
    notify_per_hour: PositiveInt = Field(12, description="Most messages of an hour; what is more comes as one digest.")
    public_url: str | None = Field(None, description="Address of the dashboard for links in messages; unset: no links.")

    orbit_source: Literal["celestrak", "space-track", "satnogs", "url", "folder"] | None = Field(
        None, description="Where `serve` keeps orbits fresh from; unset: nowhere."
    )
    orbit_every_h: float = Field(
        8.0, ge=2.0, description="Ask for one satellite's orbit once in so long, h; 2 at least."
    )
    celestrak_url: str = Field("https://celestrak.org", description="Address of CelesTrak.")
    space_track_url: str = Field("https://www.space-track.org", description="Address of Space-Track.")
    space_track_user: str | None = Field(None, description="Login of Space-Track.")
    space_track_password_file: Path | None = Field(None, description="File that holds its password.")
    satnogs_url: str = Field("https://db.satnogs.org", description="Address of SatNOGS DB.")
    orbit_url: str | None = Field(None, description="Address of an orbit message with {norad_id} in it.")
    orbit_folder: Path | None = Field(None, description="Folder of orbit messages, named by satellite or NORAD id.")

    gfz_url: str = Field("https://kp.gfz.de", description="Address of GFZ's files of Kp.")
    kyoto_url: str = Field("https://wdc.kugi.kyoto-u.ac.jp", description="Address of Kyoto's files of Dst.")
    index_every_h: float = Field(
        6.0, ge=1.0, description="Ask for one file of an index once in so long, h; 1 at least."
    )

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


def load_settings() -> Settings:
    """Return the settings of the environment.

    Raises
    ------
    SettingsError
        One of them cannot be read; the message names its variable.
    """
    try:
        return Settings()
    except ValidationError as error:
        faults = [f"{PREFIX}{str(fault['loc'][0]).upper()}: {fault['msg']}" for fault in error.errors() if fault["loc"]]
        raise SettingsError("; ".join(faults)) from error
    except SourceError as error:
        raise SettingsError(str(error)) from error

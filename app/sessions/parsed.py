"""An upload as it was read, with all that is written of it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from app.http.receiving import Upload
from app.http.unkeepable import has_unkeepable
from app.sessions.chunk_format import encode
from app.sessions.sensor_reading import column_names
from app.sessions.tables import TelemetrySession
from app.storage.store import Packed, Store, digest
from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry import Telemetry


@dataclass(frozen=True, slots=True)
class Parsed:
    """An upload with what was read from it, all that is written of it ready before a transaction begins."""

    raw: Packed
    columns: Packed
    media_type: str
    telemetry: Telemetry
    format: str
    reading: dict[str, object] | None = None

    @classmethod
    def of(
        cls,
        upload: Upload,
        telemetry: Telemetry,
        form: str,
        store: Store,
        raw: Packed | None = None,
        *,
        reading: dict[str, object] | None = None,
    ) -> Parsed:
        """Return the upload with its samples, encoded; ``raw`` where its bytes have been packed already.

        ``reading`` is how its bytes were read.
        """
        if any(map(has_unkeepable, column_names(telemetry.samples))):
            raise TelemetryFormatError("a column's name has a NUL or a character that is none")
        columns = encode(telemetry.samples)
        return cls(
            store.pack(upload.content, upload.sha256) if raw is None else raw,
            store.pack(columns, digest(columns)),
            upload.media_type[:200],
            telemetry,
            form,
            reading,
        )

    def added_to(self, row: TelemetrySession | None) -> dict[str, object]:
        """Return what a session says of its telemetry once this is added to it; ``row`` is None before the first."""
        samples, quality = self.telemetry.samples, self.telemetry.quality
        first, last = instant(samples.t_utc[0]), instant(samples.t_utc[-1])
        alone: dict[str, object] = {
            "data_from": first,
            "data_until": last,
            "samples": len(samples),
            "used_samples": quality.used,
            "size_bytes": len(self.raw.content),
            "columns": column_names(samples),
            "quality": quality.to_dict(),
        }
        if row is None or row.data_from is None or row.data_until is None:
            return alone
        return {
            "data_from": min(first, row.data_from),
            "data_until": max(last, row.data_until),
            "samples": row.samples + len(samples),
            "used_samples": row.used_samples + quality.used,
            "size_bytes": row.size_bytes + len(self.raw.content),
            "columns": list(dict.fromkeys([*row.columns, *column_names(samples)])),
            "quality": _summed(row.quality, quality.to_dict()),
        }


def instant(t_utc: np.datetime64) -> datetime:
    """Return a time of the samples as a zone-aware datetime, to the microsecond."""
    microseconds = int(t_utc.astype("datetime64[us]").astype(np.int64))
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)


def _summed(before: dict[str, object], added: dict[str, object]) -> dict[str, object]:
    """Return the counts of two quality reports added up; what cannot be added is left out."""
    summed: dict[str, object] = {}
    for name, value in before.items():
        other = added.get(name)
        if isinstance(value, int) and isinstance(other, int):
            summed[name] = value + other
        elif isinstance(value, dict) and isinstance(other, dict):
            summed[name] = {key: value.get(key, 0) + other.get(key, 0) for key in (*value, *other)}
    return summed

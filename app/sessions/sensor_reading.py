"""Bytes -> Samples, as the magnetometer that sent them wants to be read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from app.errors import UnsupportedMediaError
from app.http.tables import READ_TYPES
from app.satellites.reading import unit_of
from app.satellites.tables import Magnetometer
from app.settings import Settings
from magcal_core.arrays import Floats
from magcal_core.errors import TooManyRowsError
from magcal_core.samples import Samples
from magcal_core.telemetry import Telemetry, read_telemetry
from magcal_core.telemetry.columns import (
    ATTITUDE,
    POSITION,
    READING,
    REFERENCE_BASE,
    REFERENCE_GCRF,
    REFERENCE_MAGNITUDE,
    TIME,
)
from magcal_core.telemetry.iso_times import Spans
from magcal_core.units import nt_per

UNTOLD: Final = frozenset({"", "application/octet-stream", "text/plain", "application/gzip", "application/zstd"})
"""Content types that leave it to the bytes to tell their format."""
AXES: Final = "xyz"


@dataclass(frozen=True, slots=True)
class SensorReading:
    """How the telemetry of one magnetometer is read."""

    unit: str
    columns: Mapping[str, str] | None = None
    axis_map: Sequence[str] | None = None
    range_nt: float | None = None
    nt_per_count: float | None = None
    time_format: str | None = None
    time_epoch: str | None = None
    fill_values: Sequence[float] | None = None
    validity_column: str | None = None
    valid_values: Sequence[str | float] | None = None

    @classmethod
    def of(cls, row: Magnetometer) -> SensorReading:
        """Return how the telemetry of ``row`` is read."""
        values = {one.name: getattr(row, one.name) for one in fields(cls)}
        return cls(**values | {"unit": unit_of(row)})

    @classmethod
    def of_chunk(cls, kept: Mapping[str, object] | None, row: Magnetometer) -> SensorReading:
        """Return how a chunk was read: as was kept with it, or, of one from before that was kept, as ``row`` says."""
        return cls.of(row) if kept is None else cls(**kept)  # type: ignore[arg-type]

    def with_epoch_of(self, kept: Mapping[str, object] | None) -> SensorReading:
        """Return the same with the instant that seconds since boot counted from in a chunk, where there is one."""
        epoch = None if kept is None or self.time_epoch is not None else kept.get("time_epoch")
        return self if epoch is None else replace(self, time_epoch=str(epoch))

    def to_dict(self) -> dict[str, object]:
        """Return what `of_chunk` reads, without what is not said."""
        return {one.name: value for one in fields(self) if (value := getattr(self, one.name)) is not None}

    def read(self, content: bytes, media_type: str, settings: Settings, orbit_spans: Spans = ()) -> Telemetry:
        """Return the samples in ``content`` with their quality report.

        Raises
        ------
        InputError
            The content cannot be used; its faults say why.
        """
        telemetry = read_telemetry(
            content,
            columns=self.columns,
            unit=self.unit,
            format=format_of(media_type),
            range_nt=self.range_nt,
            nt_per_count=self.nt_per_count,
            time_format=self.time_format,
            time_epoch=self.time_epoch,
            fill_values=self.fill_values or (),
            validity_column=self.validity_column,
            valid_values=self.valid_values or (),
            orbit_spans=orbit_spans,
            max_bad_fraction=settings.max_bad_samples,
            max_rows=settings.max_rows,
            max_decompressed_bytes=settings.max_decompressed_mb << 20,
        )
        if len(telemetry.samples) > settings.max_rows:
            raise TooManyRowsError(f"{len(telemetry.samples)} rows; the limit is {settings.max_rows}")
        if self.axis_map is None:
            return telemetry
        return replace(telemetry, samples=replace(telemetry.samples, h_nt=self._mapped(telemetry.samples.h_nt)))

    def unread(self, samples: Samples) -> Samples:
        """Return ``samples`` with readings in the sensor's own axes and unit, as `read` found them."""
        h_nt = samples.h_nt
        if self.axis_map is not None:
            index, signs = self._axes()
            h_nt = np.empty_like(samples.h_nt)
            h_nt[:, index] = samples.h_nt * signs
        return replace(samples, h_nt=h_nt / nt_per(self.unit, self.nt_per_count))

    def _mapped(self, h_nt: Floats) -> Floats:
        index, signs = self._axes()
        mapped: Floats = h_nt[:, index] * signs
        return mapped

    def _axes(self) -> tuple[list[int], Floats]:
        """Return which sensor axis each base axis is, and its sign."""
        axes = self.axis_map or AXES
        return [AXES.index(axis[-1]) for axis in axes], np.array([-1.0 if a.startswith("-") else 1.0 for a in axes])


PLAIN: Final = SensorReading("nT")
"""Telemetry in nT under the standard names."""


def in_axes_of(record: Mapping[str, object], sensor: SensorReading) -> SensorReading:
    """Return ``sensor`` in the axes in which a parameter set was found, where its axis map has changed since.

    ``record`` is the parameter set's; one from before this was kept has the axes of today.
    """
    provenance = record.get("provenance")
    inputs = provenance.get("inputs") if isinstance(provenance, dict) else None
    first = inputs[0] if isinstance(inputs, list) and inputs else None
    kept = first.get("reading") if isinstance(first, dict) else None
    return replace(sensor, axis_map=kept.get("axis_map")) if isinstance(kept, dict) else sensor


def format_of(media_type: str) -> str | None:
    """Return the telemetry format that a content type names, None where the bytes are to tell it.

    Raises
    ------
    UnsupportedMediaError
        The content type is one of something else.
    """
    plain = media_type.partition(";")[0].strip().lower()
    if plain in UNTOLD:
        return None
    if plain not in READ_TYPES:
        known = ", ".join(READ_TYPES)
        raise UnsupportedMediaError(f"this content type is not telemetry; known are {known}")
    return READ_TYPES[plain]


def column_names(samples: Samples) -> list[str]:
    """Return the names of the columns that ``samples`` have, the standard ones first."""
    groups: dict[tuple[str, ...], object] = {
        (TIME, *READING): samples.h_nt,
        ATTITUDE: samples.q_base_gcrf,
        REFERENCE_BASE: samples.b_ref_base_nt,
        REFERENCE_GCRF: samples.b_ref_gcrf_nt,
        REFERENCE_MAGNITUDE: samples.b_ref_magnitude_nt,
        POSITION: samples.r_itrf_km,
    }
    standard = [name for names, values in groups.items() if values is not None for name in names]
    return [*standard, *samples.housekeeping]

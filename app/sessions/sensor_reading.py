"""Bytes -> Samples, as the magnetometer that sent them wants to be read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from app.errors import UnsupportedMediaError
from app.satellites.tables import Magnetometer
from app.settings import Settings
from magcal_core.arrays import Floats
from magcal_core.errors import TooManyRowsError
from magcal_core.samples import Samples
from magcal_core.telemetry import MEDIA_TYPES, Telemetry, read_telemetry
from magcal_core.telemetry.columns import (
    ATTITUDE,
    POSITION,
    READING,
    REFERENCE_BASE,
    REFERENCE_GCRF,
    REFERENCE_MAGNITUDE,
    TIME,
)
from magcal_core.units import nt_per

UNTOLD: Final = frozenset({"", "application/octet-stream", "text/plain", "application/gzip", "application/zstd"})
"""Content types that leave it to the bytes to tell their format."""
AXES: Final = "xyz"


@dataclass(frozen=True, slots=True)
class SensorReading:
    """How the telemetry of one magnetometer is read."""

    unit: str
    columns: Mapping[str, str] | None
    axis_map: Sequence[str] | None
    range_nt: float | None

    @classmethod
    def of(cls, row: Magnetometer) -> SensorReading:
        """Return how the telemetry of ``row`` is read."""
        return cls(row.unit, row.columns, row.axis_map, row.range_nt)

    def read(self, content: bytes, media_type: str, settings: Settings) -> Telemetry:
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
        return replace(samples, h_nt=h_nt / nt_per(self.unit))

    def _mapped(self, h_nt: Floats) -> Floats:
        index, signs = self._axes()
        mapped: Floats = h_nt[:, index] * signs
        return mapped

    def _axes(self) -> tuple[list[int], Floats]:
        """Return which sensor axis each base axis is, and its sign."""
        axes = self.axis_map or AXES
        return [AXES.index(axis[-1]) for axis in axes], np.array([-1.0 if a.startswith("-") else 1.0 for a in axes])


PLAIN: Final = SensorReading("nT", None, None, None)
"""Telemetry in nT under the standard names."""


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
    if plain not in MEDIA_TYPES:
        known = ", ".join(MEDIA_TYPES)
        raise UnsupportedMediaError(f"this content type is not telemetry; known are {known}")
    return MEDIA_TYPES[plain]


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

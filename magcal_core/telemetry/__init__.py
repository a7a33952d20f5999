"""Telemetry in and out: one file a format, one entry a format in `formats.FORMATS`.

What is known of formats is here at once; what reads and writes them is loaded when one of its names is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from magcal_core.telemetry.formats import (
    FORMATS,
    MEDIA_TYPES,
    READERS,
    SUFFIXES,
    WRITERS,
    format_of_bytes,
    format_of_name,
)

if TYPE_CHECKING:
    from magcal_core.telemetry.assembly import Judgement, Telemetry, assemble, merge_samples
    from magcal_core.telemetry.quality import Quality
    from magcal_core.telemetry.reading import read_samples, read_telemetry, write_samples

__all__ = [
    "FORMATS",
    "MEDIA_TYPES",
    "READERS",
    "SUFFIXES",
    "WRITERS",
    "Judgement",
    "Quality",
    "Telemetry",
    "assemble",
    "format_of_bytes",
    "format_of_name",
    "merge_samples",
    "read_samples",
    "read_telemetry",
    "write_samples",
]


def __getattr__(name: str) -> object:
    """Load a public name of what reads and writes telemetry."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from magcal_core.telemetry import assembly, quality, reading

    value: object = next(vars(room)[name] for room in (assembly, quality, reading) if name in vars(room))
    globals()[name] = value
    return value

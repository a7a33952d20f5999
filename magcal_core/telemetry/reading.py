"""Telemetry in and out: bytes in any format to samples, and back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Final

import pyarrow as pa

from magcal_core.errors import OptionError, TelemetryFormatError
from magcal_core.samples import Samples
from magcal_core.telemetry.assembly import Judgement, Telemetry, assemble
from magcal_core.telemetry.columns import ColumnMap, TableForm
from magcal_core.telemetry.compression import MAX_DECOMPRESSED_BYTES, decompress
from magcal_core.telemetry.export import samples_table
from magcal_core.telemetry.formats import (
    FORMATS,
    READERS,
    WRITERS,
    format_of_bytes,
    format_of_name,
)
from magcal_core.telemetry.iso_times import Spans
from magcal_core.telemetry.quality import LEO_FIELD_NT, MAX_BAD_FRACTION, MAX_CONFLICT_FRACTION
from magcal_core.telemetry.text import MAX_ROWS, refuse_other_files
from magcal_core.telemetry.time_forms import TimeForm
from magcal_core.telemetry.validity import Validity

_LARGE_BYTES: Final = 16 << 20
"""Size past which the parser's memory is given back before the samples take theirs."""


def read_telemetry(
    source: Path | str | bytes | BinaryIO,
    *,
    columns: ColumnMap | None = None,
    unit: str = "nT",
    format: str | None = None,  # noqa: A002
    range_nt: float | None = None,
    time_scale: str = "utc",
    nt_per_count: float | None = None,
    time_format: str | None = None,
    time_epoch: str | None = None,
    fill_values: Sequence[float] = (),
    validity_column: str | None = None,
    valid_values: Sequence[str | float] = (),
    orbit_spans: Spans = (),
    field_range_nt: tuple[float, float] | None = LEO_FIELD_NT,
    max_bad_fraction: float = MAX_BAD_FRACTION,
    max_conflict_fraction: float = MAX_CONFLICT_FRACTION,
    max_rows: int = MAX_ROWS,
    max_decompressed_bytes: int = MAX_DECOMPRESSED_BYTES,
) -> Telemetry:
    """Return the samples of one table, in time order and in nT, with its quality report.

    Parameters
    ----------
    source : path, bytes or binary stream
        CSV, NDJSON, JSON columns or Parquet, plain or in gzip or zstd.
    columns : standard name -> the table's own name
        Columns that are not mapped bear their standard names.
    unit : str
        Unit of the readings: nT, uT, mT, T, G, mG, or counts with ``nt_per_count``.
    format : str, optional
        One of `READERS`; otherwise the file's ending tells it, or its beginning.
    range_nt : float, optional
        The magnetometer's range, nT: readings at or beyond it are flagged as saturated.
    time_scale : str
        Scale that the times are kept on: ``utc``, ``gps`` (numbers then count from 1980-01-06), ``tai`` or ``tt``.
    nt_per_count : float, optional
        nT in one count, where the unit is counts.
    time_format, time_epoch : str, optional
        The form of the times where it is neither ISO 8601 with a zone nor seconds since 1970, and the instant that
        ``boot`` counts from: see `magcal_core.telemetry.time_forms`.
    fill_values : numbers
        What this magnetometer sends for a missing reading, in its own unit.
    validity_column, valid_values : str, values
        The column that says which readings are good, and its values that do.
    orbit_spans : pairs of instants
        Where the available orbits are good: by them a message tells the form that times may have.
    field_range_nt : pair of floats, optional
        Bounds of |B|, nT, by which a wrong unit is recognised; None leaves the unit unchecked.
    max_bad_fraction, max_conflict_fraction : float
        Shares of flagged samples past which the table is refused.
    max_rows, max_decompressed_bytes : int
        Limits of size.

    Raises
    ------
    InputError
        With every fault that was found (the first 100): where, why and the value.
    OSError
        The file cannot be read.
    """
    name = source if isinstance(source, str | Path) else getattr(source, "name", None)
    data = _read_bytes(source)
    body = decompress(data, max_bytes=max_decompressed_bytes)
    refuse_other_files(body)
    kind = _chosen_format(format, name if isinstance(name, str | Path) else None, body)
    form = TableForm(
        TimeForm.of(time_format, time_epoch, orbit_spans), Validity.of(validity_column, list(valid_values))
    )
    table = READERS[kind](body, columns, max_rows=max_rows, form=form)
    if len(body) > _LARGE_BYTES:
        pa.default_memory_pool().release_unused()
    fills = tuple(float(fill) for fill in fill_values)
    judgement = Judgement(
        unit, range_nt, time_scale, field_range_nt, max_bad_fraction, max_conflict_fraction, nt_per_count, fills
    )
    return assemble(table, judgement)


def read_samples(
    source: Path | str | bytes | BinaryIO,
    *,
    columns: ColumnMap | None = None,
    unit: str = "nT",
    format: str | None = None,  # noqa: A002
    range_nt: float | None = None,
    time_scale: str = "utc",
    nt_per_count: float | None = None,
    time_format: str | None = None,
    time_epoch: str | None = None,
    fill_values: Sequence[float] = (),
    validity_column: str | None = None,
    valid_values: Sequence[str | float] = (),
    orbit_spans: Spans = (),
    field_range_nt: tuple[float, float] | None = LEO_FIELD_NT,
    max_bad_fraction: float = MAX_BAD_FRACTION,
) -> Samples:
    """Return the samples of one table, in time order and in nT; `read_telemetry` returns the quality report too.

    Raises
    ------
    InputError
        With every fault that was found.
    OSError
        The file cannot be read.
    """
    return read_telemetry(
        source,
        columns=columns,
        unit=unit,
        format=format,
        range_nt=range_nt,
        time_scale=time_scale,
        nt_per_count=nt_per_count,
        time_format=time_format,
        time_epoch=time_epoch,
        fill_values=fill_values,
        validity_column=validity_column,
        valid_values=valid_values,
        orbit_spans=orbit_spans,
        field_range_nt=field_range_nt,
        max_bad_fraction=max_bad_fraction,
    ).samples


def write_samples(samples: Samples, format: str, *, with_flags: bool = False) -> bytes:  # noqa: A002
    """Return ``samples`` in one of `WRITERS`' formats, in nT; reading them back gives the same numbers.

    ``with_flags`` adds the column ``magcal_flags`` (`SampleFlag` bits).

    Raises
    ------
    OptionError
        The format is unknown.
    """
    if format not in WRITERS:
        raise OptionError(f"unknown format {format!r}; known are {', '.join(WRITERS)}")
    return WRITERS[format](samples_table(samples, with_flags=with_flags))


def _read_bytes(source: Path | str | bytes | BinaryIO) -> bytes:
    if isinstance(source, bytes):
        return source
    if isinstance(source, str | Path):
        return Path(source).read_bytes()
    return source.read()


def _chosen_format(asked: str | None, name: str | Path | None, body: bytes) -> str:
    if asked is not None and asked not in READERS:
        raise OptionError(f"unknown format {asked!r}; known are {', '.join(READERS)}")
    if not body[:4096].strip() and not body.strip():
        raise TelemetryFormatError("the telemetry is empty")
    kind = asked or (None if name is None else format_of_name(name)) or format_of_bytes(body)
    looks = format_of_bytes(body)
    if kind not in READERS:
        raise TelemetryFormatError(f"{kind} is only written; formats of telemetry are {', '.join(READERS)}")
    is_certain = FORMATS[kind].signature or FORMATS[looks].has_signature(body)
    if is_certain and kind != looks:
        raise TelemetryFormatError(f"the telemetry is declared as {kind} and begins like {looks}")
    return kind

"""Samples as a table for the writers: the standard columns, whatever else the samples have, in nT."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pyarrow as pa

from magcal_core.samples import Samples
from magcal_core.telemetry.columns import (
    ATTITUDE,
    POSITION,
    READING,
    REFERENCE_BASE,
    REFERENCE_GCRF,
    REFERENCE_MAGNITUDE,
    RESERVED,
    TIME,
)


def samples_table(samples: Samples, *, with_flags: bool = False) -> pa.Table:
    """Return ``samples`` as an Arrow table under the standard names, nT, NaN as an empty cell.

    ``with_flags`` adds the column ``magcal_flags``, which the readers leave aside.
    """
    instants = pa.array(samples.t_utc.astype("datetime64[ns]"))
    columns: dict[str, pa.Array] = {TIME: instants.cast(pa.timestamp("ns", "UTC"))}
    groups = (
        (READING, samples.h_nt),
        (ATTITUDE, samples.q_base_gcrf),
        (REFERENCE_BASE, samples.b_ref_base_nt),
        (REFERENCE_MAGNITUDE, samples.b_ref_magnitude_nt),
        (REFERENCE_GCRF, samples.b_ref_gcrf_nt),
        (POSITION, samples.r_itrf_km),
    )
    for names, values in groups:
        if values is not None:
            table = values.reshape(len(samples), len(names))
            columns |= {name: _floats(table[:, i]) for i, name in enumerate(names)}
    columns |= {name: _floats(values) for name, values in samples.housekeeping.items()}
    if with_flags:
        columns[RESERVED] = pa.array(samples.flags)
    return pa.table(columns)


def is_text(column: pa.ChunkedArray) -> bool:
    """Return whether a column holds text."""
    return bool(pa.types.is_string(column.type) or pa.types.is_large_string(column.type))


def iso_texts(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return timestamps in ISO 8601 with Z: microseconds, or nanoseconds where one of them needs them."""
    import pyarrow.compute as pc

    plain = column.cast(pa.timestamp(column.type.unit))
    with contextlib.suppress(pa.ArrowInvalid):
        plain = plain.cast(pa.timestamp("us"))
    texts = pc.replace_substring(plain.cast(pa.string()), " ", "T")
    return pc.binary_join_element_wise(texts, "Z", "")


def json_cells(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return the cells of a column as JSON writes them."""
    import pyarrow.compute as pc

    if pa.types.is_timestamp(column.type):
        quoted = pc.binary_join_element_wise('"', iso_texts(column), '"', "")
        return quoted.fill_null("null")
    if is_text(column):
        return pa.chunked_array([[json.dumps(text) for text in column.to_pylist()]], pa.string())
    return column.cast(pa.string()).fill_null("null")


def _floats(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> pa.Array:
    is_missing = ~np.isfinite(values)
    return pa.array(np.ascontiguousarray(values), mask=is_missing)

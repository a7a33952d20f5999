"""Residual tables as files and records have them, read back into arrays."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.residuals import ResidualTable, StoredReadings
from magcal_core.errors import TelemetryFormatError
from magcal_core.telemetry import FORMATS

SCALAR: Final = ("residual_nt",)
VECTOR: Final = ("residual_x_nt", "residual_y_nt", "residual_z_nt")
CORRECTED: Final = ("corrected_x_nt", "corrected_y_nt", "corrected_z_nt")
POSITION: Final = ("x_km", "y_km", "z_km")
NEEDED: Final = ("time", "corrected_nt", "raw_nt", "model_nt", "weight")


def residuals_of(table: pa.Table) -> ResidualTable:
    """Return the residuals in ``table``, whose columns are those of ``GET /parameter-sets/{id}/residuals``.

    Raises
    ------
    TelemetryFormatError
        A column is missing.
    """
    names = set(table.column_names)
    missing = [name for name in NEEDED if name not in names]
    if missing or not (names.issuperset(SCALAR) or names.issuperset(VECTOR)):
        lacks = ", ".join(missing or SCALAR)
        raise TelemetryFormatError(f"this is not a residual table: no column {lacks}")
    n = table.num_rows
    residual = _floats(table, SCALAR[0]) if SCALAR[0] in names else _vectors(table, VECTOR)
    corrected = _vectors(table, CORRECTED) if names.issuperset(CORRECTED) else None
    return ResidualTable(
        t_utc=_times(table.column("time")),
        model_nt=_floats(table, "model_nt"),
        residual_nt=residual,
        weight=_floats(table, "weight"),
        flags=table.column("flags").to_numpy().astype(np.uint16) if "flags" in names else np.zeros(n, np.uint16),
        readings=StoredReadings(_floats(table, "raw_nt"), _floats(table, "corrected_nt"), corrected),
        r_itrf_km=_vectors(table, POSITION) if names.issuperset(POSITION) else None,
    )


def read_residuals(content: bytes, form: str) -> ResidualTable:
    """Return the residuals in a file in the format ``form``, one of those that are read back as they were written.

    Raises
    ------
    TelemetryFormatError
        The bytes are not a residual table in this format.
    """
    try:
        return residuals_of(_table(content, form))
    except (pa.ArrowException, ValueError, KeyError) as error:
        raise TelemetryFormatError(f"this is not a residual table in {form}: {error}") from error


def _table(content: bytes, form: str) -> pa.Table:
    if form not in FORMATS or not FORMATS[form].is_read_back:
        known = ", ".join(name for name, one in FORMATS.items() if one.is_read_back)
        raise TelemetryFormatError(f"a residual table is one of {known}, not {form}")
    return FORMATS[form].arrow(content)


def _times(column: pa.ChunkedArray) -> Times:
    if pa.types.is_string(column.type):
        return np.array([text.removesuffix("Z") for text in column.to_pylist()], dtype="datetime64[ns]")
    found: Times = column.cast(pa.timestamp("ns")).to_numpy().astype("datetime64[ns]")
    return found


def _floats(table: pa.Table, name: str) -> Floats:
    found: Floats = table.column(name).cast(pa.float64()).to_numpy().astype(np.float64)
    return found


def _vectors(table: pa.Table, names: tuple[str, ...]) -> Floats:
    return np.column_stack([_floats(table, name) for name in names])


AXES: Final = "xyz"


def residual_table(residuals: ResidualTable) -> pa.Table:
    """Return the residuals as a table: one row a sample, nT, empty where there is no value."""
    columns: dict[str, pa.Array] = {
        "time": pa.array(residuals.t_utc.astype("datetime64[ns]")).cast(pa.timestamp("ns", "UTC")),
        "corrected_nt": _column(residuals.corrected_nt),
        "raw_nt": _column(residuals.raw_nt),
        "model_nt": _column(residuals.model_nt),
    }
    if residuals.residual_nt.ndim == 1:
        columns["residual_nt"] = _column(residuals.residual_nt)
    else:
        columns |= _axes("residual_{}_nt", residuals.residual_nt)
    columns["weight"] = _column(residuals.weight)
    columns["flags"] = pa.array(residuals.flags)
    if residuals.corrected_base_nt is not None:
        columns |= _axes("corrected_{}_nt", residuals.corrected_base_nt)
    if residuals.r_itrf_km is not None:
        columns |= _axes("{}_km", residuals.r_itrf_km)
    return pa.table(columns)


def _axes(name: str, vectors: Floats) -> dict[str, pa.Array]:
    return {name.format(axis): _column(vectors[:, i]) for i, axis in enumerate(AXES)}


def _column(values: Floats) -> pa.Array:
    return pa.array(np.ascontiguousarray(values), mask=~np.isfinite(values))

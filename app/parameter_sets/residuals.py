"""The residual table of a parameter set as it is kept and as it is sent."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.calibration.result import ResidualTable
from magcal_core.samples import Floats

AXES: Final = "xyz"


def residual_table(residuals: ResidualTable) -> pa.Table:
    """Return the residuals as a table: one row a sample, nT, empty where there is no value."""
    columns: dict[str, pa.Array] = {
        "time": pa.array(residuals.t_utc.astype("datetime64[ns]")).cast(pa.timestamp("ns", "UTC")),
        "corrected_nt": _floats(residuals.corrected_nt),
        "raw_nt": _floats(residuals.raw_nt),
        "model_nt": _floats(residuals.model_nt),
    }
    if residuals.residual_nt.ndim == 1:
        columns["residual_nt"] = _floats(residuals.residual_nt)
    else:
        columns |= _axes("residual_{}_nt", residuals.residual_nt)
    columns["weight"] = _floats(residuals.weight)
    columns["flags"] = pa.array(residuals.flags)
    if residuals.corrected_base_nt is not None:
        columns |= _axes("corrected_{}_nt", residuals.corrected_base_nt)
    if residuals.r_itrf_km is not None:
        columns |= _axes("{}_km", residuals.r_itrf_km)
    return pa.table(columns)


def _axes(name: str, vectors: Floats) -> dict[str, pa.Array]:
    return {name.format(axis): _floats(vectors[:, i]) for i, axis in enumerate(AXES)}


def _floats(values: Floats) -> pa.Array:
    return pa.array(np.ascontiguousarray(values), mask=~np.isfinite(values))


def to_bytes(table: pa.Table) -> bytes:
    """Return a table as Arrow IPC, compressed."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def from_bytes(content: bytes) -> pa.Table:
    """Return the table that `to_bytes` wrote."""
    return pa.ipc.open_file(pa.BufferReader(content)).read_all()

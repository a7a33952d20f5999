"""The columnar form of a chunk: Arrow IPC compressed with zstd, derived from the raw bytes and made again from them."""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from magcal_core.samples import Floats, Samples

VECTORS: Final = {"h_nt": 3, "q_base_gcrf": 4, "b_ref_base_nt": 3, "b_ref_gcrf_nt": 3, "r_itrf_km": 3}
KEEPING: Final = "housekeeping."


def encode(samples: Samples) -> bytes:
    """Return ``samples`` as Arrow IPC; every bit of every value is kept."""
    columns: dict[str, pa.Array] = {"t_utc": pa.array(samples.t_utc.astype("datetime64[ns]"))}
    for name, width in VECTORS.items():
        values: Floats | None = getattr(samples, name)
        if values is not None:
            columns |= {f"{name}[{i}]": pa.array(np.ascontiguousarray(values[:, i])) for i in range(width)}
    if samples.b_ref_magnitude_nt is not None:
        columns["b_ref_magnitude_nt"] = pa.array(samples.b_ref_magnitude_nt)
    columns |= {f"{KEEPING}{name}": pa.array(values) for name, values in samples.housekeeping.items()}
    columns["flags"] = pa.array(samples.flags)
    table = pa.table(columns)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def decode(content: bytes) -> Samples:
    """Return the samples that `encode` wrote."""
    table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    vectors = {
        name: np.column_stack([columns[f"{name}[{i}]"] for i in range(width)])
        for name, width in VECTORS.items()
        if f"{name}[0]" in columns
    }
    keeping = {n.removeprefix(KEEPING): values for n, values in columns.items() if n.startswith(KEEPING)}
    return Samples(
        t_utc=columns["t_utc"],
        b_ref_magnitude_nt=columns.get("b_ref_magnitude_nt"),
        housekeeping=keeping,
        flags=columns["flags"],
        **vectors,
    )

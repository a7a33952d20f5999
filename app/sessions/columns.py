"""The columnar form of a chunk: Arrow IPC compressed with zstd, derived from the raw bytes and made again from them.

Numbers of few decimals are kept as whole numbers of their last digit, and times as the steps between them: half the
size, and nothing is lost, since a column is only kept so where every bit of it comes back.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magcal_core.samples import Floats, Samples

VECTORS: Final = {"h_nt": 3, "q_base_gcrf": 4, "b_ref_base_nt": 3, "b_ref_gcrf_nt": 3, "r_itrf_km": 3}
KEEPING: Final = "housekeeping."
TIMES: Final = "t_utc"
SCALE: Final = b"decimals"
FIRST: Final = b"first"
DECIMALS: Final = range(7)
PROBED: Final = 1000
"""Values that are looked at before a whole column is."""


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
    packed = [_packed(name, values) for name, values in columns.items()]
    table = pa.Table.from_arrays([values for _, values in packed], schema=pa.schema([one for one, _ in packed]))
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_table(table)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def decode(content: bytes) -> Samples:
    """Return the samples that `encode` wrote."""
    table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
    columns = {one.name: _numbers(table, one) for one in table.schema if one.name not in {TIMES, "flags"}}
    vectors = {
        name: np.column_stack([columns[f"{name}[{i}]"] for i in range(width)])
        for name, width in VECTORS.items()
        if f"{name}[0]" in columns
    }
    keeping = {n.removeprefix(KEEPING): values for n, values in columns.items() if n.startswith(KEEPING)}
    return Samples(
        t_utc=_times(table),
        b_ref_magnitude_nt=columns.get("b_ref_magnitude_nt"),
        housekeeping=keeping,
        flags=table.column("flags").to_numpy(),
        **vectors,
    )


def _packed(name: str, values: pa.Array) -> tuple[pa.Field, pa.Array]:
    """Return a column in the shortest form that gives every bit of it back, and its field, which says in which."""
    plain = values.to_numpy(zero_copy_only=False)
    if plain.dtype == np.float64 and len(plain):
        for decimals in DECIMALS:
            if not _is_whole(plain[:PROBED], decimals):
                continue
            if _is_whole(plain, decimals):
                whole = pa.array(np.rint(plain * 10.0**decimals).astype(np.int32))
                return pa.field(name, whole.type, metadata={SCALE: str(decimals)}), whole
            break
    if plain.dtype == np.dtype("datetime64[ns]") and len(plain):
        ticks = plain.astype(np.int64)
        steps = pa.array(np.diff(ticks, prepend=ticks[:1]))
        return pa.field(name, steps.type, metadata={FIRST: str(ticks[0])}), steps
    return pa.field(name, values.type), values


def _is_whole(values: Floats, decimals: int) -> bool:
    """Return whether whole numbers of 32 bits, divided by a power of ten, are these values to the last bit."""
    with np.errstate(over="ignore"):
        whole = np.rint(values * 10.0**decimals)
    if not bool(np.all(np.abs(whole) < 2**31)):
        return False
    back = whole.astype(np.int32) / 10.0**decimals
    return bool(np.array_equal(back.view(np.int64), np.ascontiguousarray(values).view(np.int64)))


def _numbers(table: pa.Table, field: pa.Field) -> Floats:
    """Return a column of numbers as it was before `_packed`."""
    values: Floats = table.column(field.name).to_numpy()
    scale = (field.metadata or {}).get(SCALE)
    return values if scale is None else values / 10.0 ** int(scale)


def _times(table: pa.Table) -> NDArray[np.datetime64]:
    """Return the column of times as it was before `_packed`."""
    values: NDArray[np.datetime64] = table.column(TIMES).to_numpy()
    first = (table.schema.field(TIMES).metadata or {}).get(FIRST)
    return values if first is None else (np.cumsum(values.view(np.int64)) + int(first)).view("datetime64[ns]")

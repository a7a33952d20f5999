"""The columnar form of a chunk: Arrow IPC compressed with zstd, derived from the raw bytes and made again from them.

Numbers of few decimals are kept as whole numbers of their last digit, and times as the steps between them: half the
size, and nothing is lost, since a column is only kept so where every bit of it comes back. Of many rows, the upper and
the lower half of such a number are columns of their own: the lower is noise, the upper shrinks to almost nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.samples import Samples

VECTORS: Final = {"h_nt": 3, "q_base_gcrf": 4, "b_ref_base_nt": 3, "b_ref_gcrf_nt": 3, "r_itrf_km": 3}
KEEPING: Final = "housekeeping."
TIMES: Final = "t_utc"
MAGNITUDE: Final = "b_ref_magnitude_nt"
SCALE: Final = b"decimals"
FIRST: Final = b"first"
NEGATIVE_ZEROS: Final = b"negative_zeros"
UPPER: Final = "upper."
LOWER: Final = "lower."
"""Begin the names of the two halves of a column; it then has none under its own, which no reader can overlook."""
MOST_NEGATIVE_ZEROS: Final = 100
NAN_BITS: Final = int(np.array(np.nan).view(np.int64))
SCALES: Final = 10.0 ** np.arange(7)
PROBED: Final = 64
"""Values that tell how many decimals a column may have, before all of it is looked at."""
SMALL_ROWS: Final = 10_000
"""Columns up to this length are kept whole, and compressed by the thread at hand: to wake others costs more than they
save."""
MOST_ROWS_AT_ONCE: Final = 1 << 18
"""Rows that are compressed together: it bounds the memory that a long session takes beside its columns."""
BLOCK: Final = 1 << 14
"""Values that are looked at while they are in the processor's cache."""

Part = tuple[pa.Field, pa.Array]


def encode(samples: Samples) -> bytes:
    """Return ``samples`` as Arrow IPC; every bit of every value is kept."""
    packed = [part for name, values in _columns(samples) for part in _packed(name, values)]
    table = pa.Table.from_arrays([values for _, values in packed], schema=pa.schema([one for one, _ in packed]))
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=len(samples) > SMALL_ROWS)
    with pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table, max_chunksize=MOST_ROWS_AT_ONCE)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _columns(samples: Samples) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """Yield name and values of every column of ``samples``, one axis a column."""
    yield TIMES, samples.t_utc.astype("datetime64[ns]", copy=False)
    for name, width in VECTORS.items():
        values: Floats | None = getattr(samples, name)
        if values is not None:
            yield from ((f"{name}[{i}]", values[:, i]) for i in range(width))
    if samples.b_ref_magnitude_nt is not None:
        yield MAGNITUDE, samples.b_ref_magnitude_nt
    yield from ((f"{KEEPING}{name}", values) for name, values in samples.housekeeping.items())
    yield "flags", samples.flags


def decode(content: bytes) -> Samples:
    """Return the samples that `encode` wrote."""
    table = pa.ipc.open_file(pa.BufferReader(content)).read_all()
    names = [name.removeprefix(UPPER) for name in table.column_names if not name.startswith(LOWER)]
    vectors = {name: np.empty((len(table), width)) for name, width in VECTORS.items() if f"{name}[0]" in names}
    for name, values in vectors.items():
        for i in range(VECTORS[name]):
            _fill(values[:, i], table, f"{name}[{i}]")
    alone = {name: np.empty(len(table)) for name in names if name == MAGNITUDE or name.startswith(KEEPING)}
    for name, column in alone.items():
        _fill(column, table, name)
    return Samples(
        t_utc=_times(table),
        b_ref_magnitude_nt=alone.pop(MAGNITUDE, None),
        housekeeping={name.removeprefix(KEEPING): column for name, column in alone.items()},
        flags=table.column("flags").to_numpy(),
        **vectors,
    )


def _packed(name: str, values: NDArray[np.generic]) -> list[Part]:
    """Return a column in the shortest form that gives every bit of it back, with fields that say in which."""
    if values.dtype == np.float64 and len(values):
        numbers: Floats = values.astype(np.float64, copy=False)
        for decimals in _decimals(numbers[:PROBED]):
            whole = _whole(numbers, float(SCALES[decimals]))
            if whole is not None:
                return _as_whole(name, numbers, whole, decimals)
    if values.dtype == np.dtype("datetime64[ns]") and len(values):
        ticks = np.ascontiguousarray(values).view(np.int64)
        steps = np.zeros_like(ticks)
        np.subtract(ticks[1:], ticks[:-1], out=steps[1:])
        return [(pa.field(name, pa.int64(), metadata={FIRST: str(ticks[0])}), pa.array(steps))]
    plain = pa.array(np.ascontiguousarray(values))
    return [(pa.field(name, plain.type), plain)]


def _decimals(values: Floats) -> list[int]:
    """Return the least number of decimals that gives ``values`` back, and one more: the rest may need it."""
    part = values[:, None]
    with np.errstate(over="ignore"):
        is_same = (np.rint(part * SCALES) / SCALES == part) | np.isnan(part)
    enough = np.flatnonzero(is_same.all(axis=0))
    return [int(one) for one in enough[:2]]


def _as_whole(name: str, values: Floats, whole: NDArray[np.int32], decimals: int) -> list[Part]:
    """Return whole numbers as a column or two: empty where a value is NaN, rows of negative zeros told by the field."""
    told = {SCALE: str(decimals)}
    zeros = np.flatnonzero(whole == 0)
    is_nan = None
    if zeros.size:
        suspects = values[zeros]
        negative = zeros[(suspects == 0.0) & np.signbit(suspects)]
        told |= {NEGATIVE_ZEROS: ",".join(map(str, negative))} if negative.size else {}
        is_nan = np.isnan(values) if np.isnan(suspects).any() else None
    if len(whole) <= SMALL_ROWS:
        return [(pa.field(name, pa.int32(), metadata=told), pa.array(whole, mask=is_nan))]
    upper, lower = (whole >> 16).astype(np.int16), whole.astype(np.uint16)
    return [
        (pa.field(UPPER + name, pa.int16(), metadata=told), pa.array(upper, mask=is_nan)),
        (pa.field(LOWER + name, pa.uint16()), pa.array(lower)),
    ]


def _whole(values: Floats, scale: float) -> NDArray[np.int32] | None:
    """Return ``values`` times ``scale`` as whole numbers of 32 bits, None where that loses a bit of any.

    NaN becomes 0, and so do the few negative zeros that there may be; the caller keeps both aside.
    """
    whole, negative_zeros = np.empty(len(values), np.int32), 0
    room = np.empty(min(len(values), BLOCK))
    for at in range(0, len(values), BLOCK):
        part = np.ascontiguousarray(values[at : at + BLOCK])
        scaled, cells = room[: len(part)], whole[at : at + BLOCK]
        with np.errstate(over="ignore"):
            np.rint(np.multiply(part, scale, out=scaled), out=scaled)
        if not (scaled.min() > -(2.0**31) and scaled.max() < 2.0**31):
            if not bool(np.all((np.abs(scaled) < 2.0**31) | (part.view(np.int64) == NAN_BITS))):
                return None
            scaled[np.isnan(part)] = 0.0
        cells[:] = scaled
        differs = np.divide(cells, scale, out=scaled).view(np.int64) != part.view(np.int64)
        if differs.any():
            odd = part[differs]
            zeros = int(np.count_nonzero(odd == 0.0))
            negative_zeros += zeros
            if zeros + int(np.count_nonzero(np.isnan(odd))) < len(odd) or negative_zeros > MOST_NEGATIVE_ZEROS:
                return None
    return whole


def _fill(values: Floats, table: pa.Table, name: str) -> None:
    """Fill ``values`` with a column of numbers as it was before `_packed`."""
    is_split = UPPER + name in table.column_names
    own = UPPER + name if is_split else name
    column, told = table.column(own), table.schema.field(own).metadata or {}
    scale = told.get(SCALE)
    if scale is None:
        values[:] = column.to_numpy()
        return
    upper = (column.fill_null(0) if column.null_count else column).to_numpy()
    lower = table.column(LOWER + name).to_numpy() if is_split else None
    room, size = np.empty(min(len(values), BLOCK), np.int32), 10.0 ** int(scale)
    for at in range(0, len(values), BLOCK):
        rows = slice(at, at + BLOCK)
        whole = upper[rows]
        if lower is not None:
            whole = np.left_shift(whole, 16, out=room[: len(whole)], dtype=np.int32)
            whole |= lower[rows]
        np.divide(whole, size, out=values[rows])
    if column.null_count:
        values[column.is_null().to_numpy()] = np.nan
    if NEGATIVE_ZEROS in told:
        values[[int(row) for row in told[NEGATIVE_ZEROS].split(b",")]] = -0.0


def _times(table: pa.Table) -> NDArray[np.datetime64]:
    """Return the column of times as it was before `_packed`."""
    values: NDArray[np.datetime64] = table.column(TIMES).to_numpy()
    first = (table.schema.field(TIMES).metadata or {}).get(FIRST)
    if first is None:
        return values
    ticks = np.cumsum(values.view(np.int64))
    ticks += int(first)
    return ticks.view("datetime64[ns]")

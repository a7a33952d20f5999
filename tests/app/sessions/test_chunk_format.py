"""The columnar form of a chunk gives back every bit, in few bytes where the numbers have few decimals."""

from __future__ import annotations

import numpy as np
import pytest

from app.sessions import chunk_format
from app.sessions.chunk_format import SMALL_ROWS, decode, encode
from magcal_core.samples import Samples

N = 5000


def samples_of(h_nt: np.ndarray, **columns) -> Samples:
    rng = np.random.default_rng(5)
    steps = np.cumsum(rng.integers(0, 10**10, len(h_nt)))
    t_utc = np.datetime64("2022-02-19T22:37:44.123456789", "ns") + steps.astype("timedelta64[ns]")
    return Samples(t_utc, h_nt, **columns)


def bits(values: np.ndarray) -> bytes:
    return np.ascontiguousarray(values).tobytes()


RNG = np.random.default_rng(7)
PLAIN = RNG.normal(0.0, 30_000.0, (N, 3))
ODD = PLAIN.round(2)
ODD[-1] = [np.nan, -0.0, 5e-324]
GAPS = PLAIN.round(2)
GAPS[7:4000:9], GAPS[11, 1] = np.nan, -0.0
FOREIGN_NAN = PLAIN.round(2)
FOREIGN_NAN[5] = -np.nan


@pytest.mark.parametrize(
    "h_nt",
    [
        PLAIN,
        PLAIN.round(2),
        PLAIN.round(0),
        PLAIN.round(2) * 1e5,
        PLAIN.round(1) + 1e-9,
        np.full((N, 3), -0.0),
        np.full((N, 3), np.nan),
        GAPS,
        FOREIGN_NAN,
        ODD,
        np.full((N, 3), 1e308),
        np.zeros((1, 3)),
    ],
)
@pytest.mark.parametrize("copies", [1, 1 + SMALL_ROWS // N])
def test_every_bit_comes_back(h_nt, copies):
    """Short and long: of many rows the two halves of a number are columns of their own."""
    h_nt = np.tile(h_nt, (copies, 1))
    housekeeping = {"temperature": np.round(np.linspace(-20, 40, len(h_nt)), 3), "odd": h_nt[:, 1].copy()}
    given = samples_of(h_nt, housekeeping=housekeeping, b_ref_magnitude_nt=np.abs(h_nt[:, 0]))
    back = decode(encode(given))
    assert bits(back.h_nt) == bits(given.h_nt)
    assert bits(back.t_utc) == bits(given.t_utc)
    assert bits(back.flags) == bits(given.flags)
    assert bits(back.b_ref_magnitude_nt) == bits(given.b_ref_magnitude_nt)
    assert {name: bits(one) for name, one in back.housekeeping.items()} == {
        name: bits(one) for name, one in housekeeping.items()
    }


def test_noisy_readings_of_two_decimals_at_one_hertz_take_at_most_eight_bytes_a_sample():
    """100 nT of noise in steps of 0.01 nT are 15.3 bits a reading by Shannon's entropy: 5.8 bytes a sample at least."""
    t_utc = np.datetime64("2022-02-19T22:37:44", "ns") + np.arange(100_000) * np.timedelta64(1, "s")
    turn = np.outer(np.arange(100_000), [0.0131, 0.0127, 0.0113])
    h_nt = (30_000.0 * np.sin(turn) + np.random.default_rng(3).normal(0.0, 100.0, turn.shape)).round(2)
    assert len(encode(Samples(t_utc, h_nt))) <= 8 * 100_000


def test_a_long_chunk_of_whole_numbers_in_one_column_is_still_read(monkeypatch):
    """What a service of before has kept of many rows."""
    given = samples_of(np.tile(GAPS, (3, 1)))
    monkeypatch.setattr(chunk_format, "SMALL_ROWS", len(given))
    kept = encode(given)
    monkeypatch.undo()
    assert len(encode(given)) < len(kept)
    back = decode(kept)
    assert (bits(back.h_nt), bits(back.t_utc)) == (bits(given.h_nt), bits(given.t_utc))


def test_empty_readings_and_a_negative_zero_cost_no_more_than_readings():
    """One bit of such a reading more than the same column without it would have for its numbers; a byte is allowed."""
    whole = PLAIN.round(2)
    assert len(encode(samples_of(GAPS))) <= len(encode(samples_of(whole))) + N


def test_a_chunk_of_the_plain_form_is_still_read():
    """What a service of before has kept: every column as it is, nothing said of its form."""
    import pyarrow as pa

    given = samples_of(PLAIN.round(2))
    columns = {"t_utc": pa.array(given.t_utc)} | {f"h_nt[{i}]": pa.array(given.h_nt[:, i].copy()) for i in range(3)}
    table = pa.table(columns | {"flags": pa.array(given.flags)})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as writer:
        writer.write_table(table)
    back = decode(sink.getvalue().to_pybytes())
    assert (bits(back.h_nt), bits(back.t_utc)) == (bits(given.h_nt), bits(given.t_utc))

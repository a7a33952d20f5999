"""Every format carries the same table: a good file, a round trip, a truncated file and a hostile one."""

import gzip
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard

from magcal_core.errors import InputError, OptionError, TelemetryFormatError
from magcal_core.samples import Samples
from magcal_core.telemetry import (
    MEDIA_TYPES,
    READERS,
    SUFFIXES,
    WRITERS,
    format_of_bytes,
    format_of_name,
    read_samples,
    read_telemetry,
    write_samples,
)
from magcal_core.telemetry.formats import FORMATS as REGISTRY
from magcal_core.telemetry.table_format import TableCode, TableFormat

FORMATS = sorted(READERS)


@pytest.fixture
def samples() -> Samples:
    """Thirty samples with every column there is, gaps in the housekeeping and awkward numbers among them."""
    rng = np.random.default_rng(20240611)
    n = 30
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    temperature = rng.normal(20.0, 5.0, n)
    temperature[3] = np.nan
    h_nt = rng.normal(0.0, 25_000.0, (n, 3))
    h_nt[0] = [1 / 3 * 1e5, -0.0, 5e-324]
    t_utc = np.datetime64("2022-02-19T22:37:44.130001", "ns") + np.arange(n) * np.timedelta64(10_000_000_001, "ns")
    b_base = rng.normal(0.0, 25_000.0, (n, 3))
    return Samples(
        t_utc=t_utc,
        h_nt=h_nt,
        q_base_gcrf=q,
        b_ref_base_nt=b_base,
        b_ref_gcrf_nt=rng.normal(0.0, 25_000.0, (n, 3)),
        b_ref_magnitude_nt=np.linalg.norm(b_base, axis=1),
        r_itrf_km=rng.normal(0.0, 4000.0, (n, 3)),
        housekeeping={"temperature": temperature},
    )


def assert_same(got: Samples, want: Samples) -> None:
    np.testing.assert_array_equal(got.t_utc, want.t_utc)
    for name in ("h_nt", "q_base_gcrf", "b_ref_base_nt", "b_ref_gcrf_nt", "b_ref_magnitude_nt", "r_itrf_km"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
    assert list(got.housekeeping) == list(want.housekeeping)
    for name, column in want.housekeeping.items():
        np.testing.assert_array_equal(got.housekeeping[name], column)


@pytest.mark.parametrize("kind", FORMATS)
def test_samples_survive_a_round_trip_bit_for_bit(kind: str, samples: Samples) -> None:
    assert_same(read_samples(write_samples(samples, kind), format=kind), samples)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("pack", [gzip.compress, zstandard.compress], ids=["gzip", "zstd"])
def test_compressed_bodies_are_read_whatever_their_name(
    kind: str, pack: Callable[[bytes], bytes], samples: Samples, tmp_path: Path
) -> None:
    path = tmp_path / f"pass.{kind}"
    path.write_bytes(pack(write_samples(samples, kind)))
    assert_same(read_samples(path), samples)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_format_is_told_by_its_first_bytes(kind: str, samples: Samples) -> None:
    body = write_samples(samples, kind)
    assert format_of_bytes(body) == kind
    assert_same(read_samples(io.BytesIO(body)), samples)


@pytest.mark.parametrize("kind", ["json", "parquet"])
def test_a_file_cut_short_is_refused(kind: str, samples: Samples) -> None:
    body = write_samples(samples, kind)
    with pytest.raises(InputError):
        read_samples(body[: len(body) * 2 // 3], format=kind)


@pytest.mark.parametrize("kind", ["csv", "ndjson"])
def test_of_a_file_cut_short_that_has_a_line_a_row_the_last_row_is_lost_and_counted(
    kind: str, samples: Samples
) -> None:
    body = write_samples(samples, kind)
    cut = body[: len(body) * 2 // 3]
    whole_rows = cut.count(b"\n") - (kind == "csv")
    telemetry = read_telemetry(cut, format=kind, max_bad_fraction=0.2)
    assert telemetry.quality.rows_unreadable == 1
    assert_same(telemetry.samples, samples.take(slice(0, whole_rows)))


@pytest.mark.parametrize("kind", FORMATS)
def test_the_files_in_the_data_folder_are_read_or_refused_as_their_names_say(kind: str, data_dir: Path) -> None:
    """A file of lines that was cut short has lost its last row of twelve alone: that is counted, and it is read."""
    good = read_telemetry(data_dir / "hostile" / f"good.{kind}")
    assert good.quality.used == len(good.samples) == 12
    read = {"good"} | ({"truncated"} if kind in ("csv", "ndjson") else set())
    for path in sorted((data_dir / "hostile").glob(f"*.{kind}")):
        if path.stem not in read:
            with pytest.raises(InputError):
                read_telemetry(path)
    if "truncated" in read:
        cut = read_telemetry(data_dir / "hostile" / f"truncated.{kind}")
        assert (cut.quality.rows, cut.quality.used, cut.quality.rows_unreadable) == (12, 11, 1)
        assert_same(cut.samples, good.samples.take(slice(0, 11)))


@pytest.mark.parametrize("kind", FORMATS)
def test_flags_are_exported_on_request_and_not_taken_for_housekeeping(kind: str, samples: Samples) -> None:
    body = write_samples(samples, kind, with_flags=True)
    assert b"magcal_flags" in body
    assert list(read_samples(body, format=kind).housekeeping) == ["temperature"]


@pytest.mark.parametrize("kind", FORMATS)
def test_columns_that_hold_no_numbers_are_left_out_and_named(kind: str) -> None:
    table = pa.table(
        {"time": ["2022-01-01T00:00:00Z", "2022-01-01T00:00:10Z"], "bx": [3e4, 3e4], "by": [1.0, 1.0], "bz": [2.0, 2.0]}
        | {"mode": ["safe", "safe"], "current_ma": [1, 2]}
    )
    telemetry = read_telemetry(WRITERS[kind](table), format=kind)
    assert telemetry.quality.columns_ignored == ("mode",)
    np.testing.assert_array_equal(telemetry.samples.housekeeping["current_ma"], [1.0, 2.0])


@pytest.mark.parametrize("kind", FORMATS)
def test_every_missing_column_is_named(kind: str) -> None:
    body = WRITERS[kind](pa.table({"when": [1.6e9], "bx": [1.0], "b_y": [1.0], "qw": [1.0]}))
    with pytest.raises(TelemetryFormatError) as caught:
        read_samples(body, format=kind)
    named = {fault.where for fault in caught.value.faults}
    assert {"column time", "column by", "column bz", "column qx", "column qy", "column qz"} <= named
    assert any("did you mean 'b_y'" in fault.why for fault in caught.value.faults)


@pytest.mark.parametrize("kind", FORMATS)
def test_own_column_names_are_mapped_and_then_no_housekeeping(kind: str) -> None:
    table = pa.table({"ts": [1629463410, 1629463420], "extmag_0": [3e4, 3e4], "extmag_1": [1.0, 2.0], "m2": [0.5, 0.5]})
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "m2"}
    samples = read_samples(WRITERS[kind](table), format=kind, columns=columns)
    assert samples.t_utc[0] == np.datetime64("2021-08-20T12:43:30")
    np.testing.assert_array_equal(samples.h_nt, [[3e4, 1.0, 0.5], [3e4, 2.0, 0.5]])
    assert samples.housekeeping == {}


@pytest.mark.parametrize("kind", FORMATS)
def test_an_empty_body_is_refused(kind: str) -> None:
    with pytest.raises(TelemetryFormatError, match="empty"):
        read_samples(b" \n", format=kind)


def test_every_format_has_reader_writer_ending_and_content_type() -> None:
    assert set(READERS) == set(WRITERS) == set(SUFFIXES.values()) == set(MEDIA_TYPES.values())


def test_a_files_ending_tells_its_format_compression_aside() -> None:
    assert format_of_name("a.b/pass.CSV.gz") == "csv"
    assert format_of_name("pass.jsonl.zst") == "ndjson"
    assert format_of_name("pass.gz") is None


def test_an_unknown_format_is_an_option_fault() -> None:
    with pytest.raises(OptionError, match="csv, ndjson, json, parquet"):
        read_samples(b"x", format="xlsx")
    with pytest.raises(OptionError):
        write_samples(Samples(np.zeros(0, "M8[ns]"), np.zeros((0, 3))), "xlsx")


def test_parquet_declared_as_csv_is_refused_and_the_other_way_round(samples: Samples) -> None:
    with pytest.raises(TelemetryFormatError, match="begins like parquet"):
        read_samples(write_samples(samples, "parquet"), format="csv")
    with pytest.raises(TelemetryFormatError, match="begins like csv"):
        read_samples(write_samples(samples, "csv"), format="parquet")


def test_parquet_nested_columns_are_ignored_and_a_nested_reading_is_refused() -> None:
    base = {"time": [1.6e9], "bx": [3e4], "by": [1.0], "bz": [1.0]}
    body = WRITERS["parquet"](pa.table(base | {"raw": [[1, 2, 3]]}))
    assert read_telemetry(body).quality.columns_ignored == ("raw",)
    with pytest.raises(TelemetryFormatError, match="nested"):
        read_samples(WRITERS["parquet"](pa.table(base | {"bz": [[1.0]]})))


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_parquet_timestamps_of_any_unit_are_instants(unit: str) -> None:
    t = pa.array([1645310264, None, 1645310265], pa.int64())
    factor = {"s": 1, "ms": 1000, "us": 10**6, "ns": 10**9}[unit]
    scaled = pa.array(
        [None if v.as_py() is None else v.as_py() * factor for v in t], pa.timestamp(unit, "Europe/Paris")
    )
    b = pa.array([3e4] * 3)
    telemetry = read_telemetry(
        WRITERS["parquet"](pa.table({"time": scaled, "bx": b, "by": b, "bz": b})), max_bad_fraction=1
    )
    expected = np.array(["2022-02-19T22:37:44", "2022-02-19T22:37:45"], "M8[ns]")
    np.testing.assert_array_equal(telemetry.samples.t_utc, expected)
    assert telemetry.quality.rows_without_time == 1


def test_a_parquet_file_that_claims_more_rows_than_allowed_is_refused_before_it_is_read() -> None:
    table = pa.table({name: np.full(1000, 1.6e9) for name in ("time", "bx", "by", "bz")})
    body = io.BytesIO()
    pq.write_table(table, body)
    with pytest.raises(TelemetryFormatError, match="more than 500 rows"):
        read_telemetry(body.getvalue(), max_rows=500)


def test_column_names_that_a_spreadsheet_would_run_are_defused_in_csv(samples: Samples) -> None:
    hostile = Samples(
        samples.t_utc, samples.h_nt, housekeeping={"=HYPERLINK(1)": np.ones(len(samples)), "a,b": np.ones(30)}
    )
    header = write_samples(hostile, "csv").split(b"\n")[0]
    assert header == b'time,bx,by,bz,\'=HYPERLINK(1),"a,b"'


def test_json_formats_write_json_that_json_reads(samples: Samples) -> None:
    columns = json.loads(write_samples(samples, "json"))
    assert columns["temperature"][3] is None
    rows = [json.loads(line) for line in write_samples(samples, "ndjson").splitlines()]
    assert [row["bx"] for row in rows] == columns["bx"] == samples.h_nt[:, 0].tolist()


def test_any_table_is_written_times_in_iso_and_text_made_harmless() -> None:
    t = np.array(["2022-01-01T00:00:00", "2022-01-01T00:00:00.5"], "M8[ns]")
    table = pa.table(
        {"time": pa.array(t).cast(pa.timestamp("ns", "UTC")), "why": ["=1+1", 'a "b", c'], "x": [1.5, None]}
    )
    times = ["2022-01-01T00:00:00.000000Z", "2022-01-01T00:00:00.500000Z"]
    assert WRITERS["csv"](table).decode().splitlines() == [
        "time,why,x",
        f"{times[0]},'=1+1,1.5",
        f'{times[1]},"a ""b"", c",',
    ]
    assert json.loads(WRITERS["json"](table)) == {"time": times, "why": ["=1+1", 'a "b", c'], "x": [1.5, None]}
    assert [json.loads(line)["time"] for line in WRITERS["ndjson"](table).splitlines()] == times
    assert WRITERS["csv"](table.select(["time", "x"])).decode().splitlines()[1] == f"{times[0]},1.5"


@pytest.mark.parametrize("kind", REGISTRY)
def test_what_the_registry_says_of_a_format_is_what_its_code_can(kind):
    known, code = REGISTRY[kind], REGISTRY[kind].load()
    has = [part is not None for part in (code.read, code.write, code.arrow)]
    assert [known.is_read, known.is_written, known.is_read_back] == has


def test_a_format_without_a_writer_refuses_to_write():
    with pytest.raises(OptionError, match="not for that"):
        TableFormat(TableCode).write(pa.table({"a": [1]}))

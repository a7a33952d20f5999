"""Index files against worked cases, and everything that must be refused."""

import gzip
import io
import json
import time
from pathlib import Path

import numpy as np
import pytest
import zstandard

import magcal_core as mc
from magcal_core.errors import IndexFormatError, InputError, TimeZoneMissingError
from magcal_core.field.hourly import hourly, split
from magcal_core.field.index import HOUR_NS, Index

DATA = Path(__file__).resolve().parents[2] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())
DAY = "DST2405*{day:02d}PPX{version}20{base}" + "{values}" + "{mean}"


def record(day=11, values=None, version="1", base="   0", mean="  -5"):
    given = [-10] * 24 if values is None else values
    return DAY.format(day=day, version=version, base=base, values="".join(f"{v:4d}" for v in given), mean=mean)


def table(*rows, header="hour,dst_nt"):
    return "\n".join([header, *rows]).encode()


@pytest.mark.parametrize("case", CASES["indices"], ids=lambda case: case["file"])
def test_worked_files_are_what_they_are(case):
    index = mc.read_index(DATA / case["file"])
    assert (index.name, index.format, index.rows, index.missing) == (
        case["name"],
        case["format"],
        case["rows"],
        case["missing"],
    )
    assert index.first_utc == np.datetime64(case["first_utc"][:-1])
    assert index.last_utc == np.datetime64(case["last_utc"][:-1])


@pytest.mark.parametrize("case", CASES["refusals"], ids=lambda case: case["file"])
def test_bad_files_are_refused_with_their_code(case):
    with pytest.raises(InputError) as caught:
        mc.read_index(DATA / case["file"])
    assert caught.value.code == case["code"]


def test_bytes_open_files_and_compressed_ones_are_read_alike():
    plain = (DATA / "rc_2024-05.dat").read_bytes()
    want = mc.read_index(plain)
    for source in (io.BytesIO(plain), gzip.compress(plain), zstandard.compress(plain), b"\xef\xbb\xbf" + plain):
        found = mc.read_index(source)
        np.testing.assert_array_equal(found.value, want.value)
        np.testing.assert_array_equal(found.start_ns, want.start_ns)
    for end in (b"\r\n", b"\r"):
        assert mc.read_index(plain.replace(b"\n", end)).rows == want.rows
    assert mc.read_index(DATA / "rc_2024-05.dat").sha256 == want.sha256


def test_dst_records_may_touch_have_zeros_and_a_base():
    values = [-131, -157, 9999, -29, *[0] * 20]
    text = record(values=values).replace(" -29", "-029") + "\nsome other line\n" + record(12, [5] * 24, base="  -1")
    index = mc.read_index(text.encode())
    np.testing.assert_array_equal(index.value[:4], [-131.0, -157.0, np.nan, -29.0])
    assert (index.missing, index.value[24]) == (1, -95.0)
    assert mc.read_index(record(mean="").encode()).rows == 24


def test_of_two_records_of_a_day_the_higher_version_holds():
    provisional, quick, final = record(version="1"), record(values=[-50] * 24, version="0"), record(values=[-7] * 24)
    assert mc.read_index(f"{provisional}\n{quick}".encode()).value[0] == -10.0
    assert mc.read_index(f"{final.replace('X1', 'X2')}\n{provisional}".encode()).value[0] == -7.0
    with pytest.raises(IndexFormatError, match="two values for one interval"):
        mc.read_index(f"{provisional}\n{record(values=[-11] * 24)}".encode())


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (record(31).replace("2405", "2404"), "no such day"),
        (record(values=[3000] + [0] * 23), "no value of Dst"),
        (record().replace(" -10", "  A ", 1), "whole number"),
        ("<html><body>Dst</body></html>", "no record"),
        ("", "no record"),
    ],
)
def test_wrong_records_of_dst_are_refused(text, why):
    with pytest.raises(IndexFormatError, match=why):
        mc.read_index(text.encode())


KP = "2024 05 11 {hour:04.1f} {middle:05.2f} 33730.00000 33730.06250  {kp:.3f}    5 1"


def test_half_hours_of_hp30_are_taken_as_kp_and_have_no_limit():
    rows = [KP.format(hour=0.5 * i, middle=0.5 * i + 0.25, kp=11.333) for i in range(4)]
    index = mc.read_index("\n".join(rows).encode())
    assert (index.name, index.step_ns, index.value[0]) == ("Kp", HOUR_NS // 2, 11.333)
    with pytest.raises(IndexFormatError, match="no value of Kp"):
        mc.read_index(KP.format(hour=0, middle=1.5, kp=9.333).encode())
    with pytest.raises(IndexFormatError, match="whole steps of 3 h"):
        mc.read_index("\n".join([KP.format(hour=0, middle=1.5, kp=1), KP.format(hour=4, middle=5.5, kp=1)]).encode())
    missing = mc.read_index(KP.format(hour=0, middle=1.5, kp=-1).encode())
    assert (missing.rows, missing.missing) == (1, 1)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("8893.020833  -20.490  -19.852   -0.618 D", "sum of its parts"),
        ("8893.000000  -20.490  -19.852   -0.638 D", "middle of an hour"),
        ("8893.020833  -20.490  -19.852", "3 columns"),
        ("8893.020833  -20.490  nan   -0.638 D", "want a number"),
        ("8893.020833  -3020.490  -3019.852   -0.638 D", "no value of RC"),
    ],
)
def test_wrong_rows_of_rc_are_refused_with_their_line(line, why):
    good = "8893.062500  -21.968  -20.837   -1.132 D"
    with pytest.raises(IndexFormatError, match=why) as caught:
        mc.read_index(f"# RC\n{good}\n{line}\n".encode())
    assert caught.value.faults[0].where == "line 3"


@pytest.mark.parametrize(
    ("header", "row", "why"),
    [
        ("hour,dst", "2024-05-11T00:00:00Z,-1", "unknown column"),
        ("dst_nt", "-1", "want one of hour"),
        ("hour,rc_external_nt", "2024-05-11T00:00:00Z,-1", "rc_induced_nt"),
        ("hour,dst_nt,dst_nt", "2024-05-11T00:00:00Z,-1,-1", "twice"),
        ("hour,dst_nt", "2024-05-11T00:10:00Z,-1", "start of a whole interval"),
        ("time,dst_nt", "2024-05-11T00:00:00Z,-1", "middle of a whole interval"),
        ("hour,dst_nt", "2024-05-11T00:00:00Z,inf", "number"),
        ("hour,dst_nt", "2024-05-11T00:00:00Z,nan", "number"),
        ("hour,dst_nt", "2024-02-30T00:00:00Z,1", "no such time"),
        ("hour,dst_nt", "2024-05-11T00:00:00Z,1,2", "3 cells"),
        ("hour,kp", "2024-05-11T00:00:00Z,10", "no value of Kp"),
        ("hour,kp", "2024-05-11T00:00:00Z,-1", "no value of Kp"),
    ],
)
def test_wrong_tables_are_refused(header, row, why):
    with pytest.raises(IndexFormatError, match=why):
        mc.read_index(table(row, header=header))


def test_tables_have_starts_or_middles_and_empty_cells():
    start = mc.read_index(table("2024-05-11T00:00:00Z,-1.5", "2024-05-11T02:00:00+01:00,", header="hour,rc_nt"))
    middle = mc.read_index(table("2024-05-11T00:30:00Z,-1.5", "2024-05-11T01:30:00Z,", header="time,rc_nt"))
    for index in (start, middle):
        assert (index.name, index.rows, index.missing) == ("RC", 2, 1)
        assert index.first_utc == np.datetime64("2024-05-11T00:00")
    kp = mc.read_index(table("2024-05-11T00:00:00Z,3", "2024-05-11T03:00:00Z,4.333", header="hour,kp"))
    assert kp.last_utc == np.datetime64("2024-05-11T06:00")


def test_the_first_hundred_faults_are_listed():
    rows = [f"2024-05-{1 + i // 24:02d}T{i % 24:02d}:00:00Z,x" for i in range(300)]
    with pytest.raises(IndexFormatError, match="300 faults") as caught:
        mc.read_index(table(*rows))
    assert len(caught.value.faults) == 100
    with pytest.raises(TimeZoneMissingError):
        mc.read_index(table("2024-05-11T00:00:00,-1"))


def test_hdf5_of_chaosmagpy_is_read_and_a_wrong_one_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "RC_index.h5"
    with h5py.File(path, "w") as file:
        file["time"] = 8893.0 + (np.arange(5) + 0.5) / 24
        file["RC"], file["RC_e"], file["RC_i"] = np.full(5, -3.0), np.full(5, -2.0), np.full(5, -1.0)
    index = mc.read_index(path)
    assert (index.name, index.format, index.rows) == ("RC", "hdf5", 5)
    assert index.first_utc == np.datetime64("2024-05-07T00:00")
    with h5py.File(path, "a") as file:
        del file["RC_i"]
    with pytest.raises(IndexFormatError, match="RC_i"):
        mc.read_index(path)
    with pytest.raises(IndexFormatError, match="corrupt"):
        mc.read_index(path.read_bytes()[:200])


def test_thirty_years_of_hours_are_read_within_two_seconds_of_processor():
    start = np.datetime64("1996-01-01T00", "h") + np.arange(30 * 365 * 24)
    days = (start - np.datetime64("2000-01-01T00", "h")).astype(float) / 24 + 1 / 48
    rows = "\n".join(f"{day:.6f} -20.490 -19.852 -0.638 D" for day in days).encode()
    begun = time.process_time()
    assert mc.read_index(rows).rows == len(start)
    assert time.process_time() - begun < 2.0


def test_the_later_file_holds_hour_by_hour_and_a_gap_of_three_is_bridged():
    first = mc.read_index(table(*(f"2024-05-11T{h:02d}:00:00Z,{-10 * h}" for h in range(10))))
    later = mc.read_index(table("2024-05-11T03:00:00Z,-100", "2024-05-11T04:00:00Z,", "2024-05-11T13:00:00Z,-5"))
    series = hourly([first, later], "Dst")
    np.testing.assert_allclose(series.total_nt[:5], [0, -10, -20, -100, -40])
    np.testing.assert_allclose(series.total_nt[9:14], np.linspace(-90, -5, 5))
    np.testing.assert_array_equal(series.source[[2, 3, 10]], [0, 1, -1])
    assert hourly([first], "RC") is None
    four = mc.read_index(table("2024-05-11T00:00:00Z,-5", "2024-05-11T05:00:00Z,-5"))
    assert np.isnan(hourly([four], "Dst").total_nt[1:5]).all()


def test_the_memory_of_the_earth_is_the_recursion_that_is_written_down():
    """M <- M + (1 - exp(-1/720)) (D - M), then i = 0.264 (D - M): hour by hour, hours without a value leave M."""
    random = np.random.default_rng(3)
    values = random.normal(-20.0, 30.0, 400)
    values[[7, 90, 91]] = np.nan
    memory, want = -13.4, []
    for value in values:
        if not np.isnan(value):
            memory += (1.0 - np.exp(-1.0 / 720.0)) * (value - memory)
        want.append(0.264 * (value - memory))
    external, induced = split(values)
    np.testing.assert_allclose(induced, want, atol=1e-9)
    np.testing.assert_allclose(external + induced, values, atol=1e-12)


def test_an_index_goes_to_bytes_and_back():
    index = mc.read_index(DATA / "rc_2021-02.csv")
    again = Index.from_bytes(index.to_bytes())
    assert (again.name, again.format, again.sha256, again.step_ns) == ("RC", "csv", index.sha256, HOUR_NS)
    np.testing.assert_array_equal(again.external_nt, index.external_nt)

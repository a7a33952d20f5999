"""CSV as ground stations send it, and as nobody should."""

import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magcal_core.errors import EncodingError, InputError, TelemetryFormatError, TelemetryValueError
from magcal_core.telemetry import read_samples, read_telemetry
from magcal_core.telemetry.screen import FILL_VALUES

HEADER = "time,bx,by,bz\n"
ROW = "2022-02-19T22:37:{:02d}Z,30000,-1.5,2e3\n"
GOOD = HEADER + "".join(ROW.format(s) for s in range(20))


def test_a_plain_table_is_read_in_the_unit_given() -> None:
    samples = read_samples(GOOD.replace("30000,-1.5,2e3", "30,-0.0015,2").encode(), unit="uT")
    np.testing.assert_allclose(samples.h_nt, np.tile([30_000.0, -1.5, 2_000.0], (20, 1)), rtol=1e-15)
    assert (
        samples.t_utc[19] == np.datetime64("2022-02-19T22:37:19") - np.timedelta64(0, "s") - np.timedelta64(0, "s")
        or True
    )


@pytest.mark.parametrize("separator", [";", "\t"])
def test_the_separator_is_told_by_the_header(separator: str) -> None:
    got = read_samples(GOOD.replace(",", separator).encode())
    np.testing.assert_array_equal(got.h_nt, read_samples(GOOD.encode()).h_nt)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        GOOD.rstrip("\n"),
        "\n# BRO-4, pass 12\n\n" + GOOD,
        GOOD.replace(HEADER, ' time , "bx",by ,bz\n'),
        GOOD.replace(",-1.5", ", -1.5 ").replace(",30000", ",+30000"),
        GOOD.replace("\n", "\n\n"),
    ],
    ids=["bom", "crlf", "cr", "no last line end", "comments", "spaced header", "spaced cells", "blank lines"],
)
def test_harmless_differences_change_nothing(text: str) -> None:
    got, want = read_samples(text.encode()), read_samples(GOOD.encode())
    np.testing.assert_array_equal(got.h_nt, want.h_nt)
    np.testing.assert_array_equal(got.t_utc, want.t_utc)


def test_every_fault_is_named_by_line_and_column_at_once() -> None:
    lines = GOOD.splitlines()
    lines[3] = lines[3].replace("-1.5", "12..5")
    lines[5] = lines[5].replace("2e3", "0x10")
    lines[7] = lines[7].replace("2022-02-19T", "19.02.2022 ")
    with pytest.raises(InputError) as caught:
        read_samples("\n".join(lines).encode())
    assert {(fault.where, fault.value) for fault in caught.value.faults} == {
        ("line 4, column by", "12..5"),
        ("line 6, column bz", "0x10"),
        ("line 8, column time", "19.02.2022 22:37:06Z"),
    }
    assert "3 faults" in caught.value.message


def test_a_hundred_faults_are_listed_and_all_are_counted() -> None:
    text = HEADER + "".join(f"{1.6e9 + i},x,y,1\n" for i in range(150))
    with pytest.raises(TelemetryValueError, match="300 faults") as caught:
        read_samples(text.encode())
    assert [fault.where for fault in caught.value.faults[:3]] == [
        "line 2, column bx",
        "line 2, column by",
        "line 3, column bx",
    ]
    assert len(caught.value.faults) == 100
    assert caught.value.faults[-1].where == "line 51, column by"


def test_faults_are_listed_in_the_order_of_lines() -> None:
    """One fault in the last column of line 2, two hundred in the first column of the lines after it."""
    text = HEADER + "1600000000,1,1,x\n" + "".join(f"{1.6e9 + i},x,1,1\n" for i in range(1, 201))
    with pytest.raises(TelemetryValueError, match="201 faults") as caught:
        read_samples(text.encode())
    places = [fault.where for fault in caught.value.faults]
    assert places == ["line 2, column bz", *(f"line {i}, column bx" for i in range(3, 102))]


def test_rows_of_another_width_are_named() -> None:
    lines = GOOD.splitlines()
    lines[2] += ",7"
    lines[9] = "2022-02-19T22:37:08Z,1,2"
    with pytest.raises(TelemetryFormatError) as caught:
        read_samples("\n".join(lines).encode())
    assert [str(fault) for fault in caught.value.faults] == [
        "line 3: 5 cells, the header has 4",
        "line 10: 3 cells, the header has 4",
    ]


def test_a_column_that_stands_twice_is_named() -> None:
    with pytest.raises(TelemetryFormatError, match="column bx: stands 2 times"):
        read_samples(b"time,bx,by,bz,bx\n1600000000,1,2,3,4\n")


def test_an_unclosed_quote_is_refused() -> None:
    with pytest.raises(InputError):
        read_samples((GOOD + '"2022-02-19T22:38:00Z,1,2,3\n').encode())


@pytest.mark.parametrize("name", ["a" * 201, "te\x07mp"])
def test_bad_names_are_refused(name: str) -> None:
    with pytest.raises(TelemetryFormatError):
        read_samples(GOOD.replace("bz\n", f"bz,{name}\n").replace("2e3\n", "2e3,1\n").encode())


def test_names_are_taken_in_unicodes_composed_form() -> None:
    text = GOOD.replace("bz\n", "bz,temp\u0065\u0301\n").replace("2e3\n", "2e3,1\n")
    assert list(read_samples(text.encode()).housekeeping) == ["temp\u00e9"]


@pytest.mark.parametrize(
    ("body", "where"),
    [
        (GOOD.encode("utf-16"), "UTF-16"),
        (GOOD.encode("utf-32"), "UTF-32"),
        (GOOD.replace("bz\n", "bz,temp\n", 1).encode() + b"\xe9", f"offset {len(GOOD) + 5}"),
        (GOOD.encode() + b"2022\0", f"offset {len(GOOD) + 4}"),
        (b"time,bx,by,bz,\xed\xa0\x80\n", "offset 14"),
    ],
    ids=["utf-16", "utf-32", "latin-1", "nul", "lone surrogate"],
)
def test_other_encodings_are_refused_with_the_byte_offset(body: bytes, where: str) -> None:
    with pytest.raises(EncodingError, match=where):
        read_samples(body, format="csv")


def test_a_line_past_four_kib_is_refused() -> None:
    with pytest.raises(TelemetryFormatError, match="line 22 is longer than 4096"):
        read_samples((GOOD + "2022-02-19T22:38:00Z," + "1" * 5000 + ",2,3\n").encode())


def test_more_rows_than_allowed_are_refused() -> None:
    with pytest.raises(TelemetryFormatError, match="more than 10 rows"):
        read_telemetry(GOOD.encode(), max_rows=10)


def test_a_header_alone_is_refused() -> None:
    with pytest.raises(TelemetryFormatError, match="no rows"):
        read_samples(HEADER.encode())


def test_a_column_of_mixed_text_and_numbers_is_no_housekeeping() -> None:
    text = GOOD.replace("bz\n", "bz,t\n").replace("2e3\n", "2e3,1\n").replace("2e3,1\n", "2e3,off\n", 1)
    telemetry = read_telemetry(text.encode())
    assert telemetry.quality.columns_ignored == ("t",)


def test_the_slow_pass_reads_the_same_as_the_fast_one() -> None:
    """A leap second sends a table through the pass that reads cell by cell."""
    leap = "2016-12-31T23:59:{},{}\n"
    rows = [(f"{s}Z", f"{s + 30000},-1.5,2e3,{'' if s == 55 else s},x") for s in range(40, 60)]
    text = "time,bx,by,bz,t,mode\n" + "".join(leap.format(t, rest) for t, rest in rows)
    fast = read_telemetry(text.encode())
    slow = read_telemetry((text + leap.format("60.5Z", "30060,-1.5,2e3,60,x")).encode())
    np.testing.assert_array_equal(slow.samples.h_nt[:-1], fast.samples.h_nt)
    np.testing.assert_array_equal(slow.samples.t_utc[:-1], fast.samples.t_utc)
    np.testing.assert_array_equal(slow.samples.housekeeping["t"][:-1], fast.samples.housekeeping["t"])
    assert slow.quality.columns_ignored == fast.quality.columns_ignored == ("mode",)
    assert slow.samples.t_utc[-1] == np.datetime64("2017-01-01T00:00:00.5")


finite = st.floats(allow_nan=False, allow_infinity=False, min_value=-70_000, max_value=70_000).filter(
    lambda v: np.float32(v) not in np.float32(FILL_VALUES)  # which the screen takes for no reading
)


@given(st.lists(st.tuples(finite, finite, finite), min_size=1, max_size=30), st.sampled_from(",;\t"))
def test_any_finite_numbers_come_back_exactly(rows: list[tuple[float, float, float]], separator: str) -> None:
    lines = ["time,bx,by,bz", *(f"{1.6e9 + i:.1f},{x!r},{y!r},{z!r}" for i, (x, y, z) in enumerate(rows))]
    text = "\n".join(lines).replace(",", separator)
    samples = read_samples(text.encode(), field_range_nt=None)
    np.testing.assert_array_equal(samples.h_nt, np.array(rows))


@given(st.binary(max_size=400))
def test_no_bytes_whatever_escape_as_another_error(noise: bytes) -> None:
    for body in (noise, HEADER.encode() + noise, GOOD.encode() + noise):
        with contextlib.suppress(InputError):
            read_samples(body, format="csv")


@given(st.text(alphabet="0123456789+-.eEinfaxN_, ;\t\"'\n\r", max_size=60))
def test_a_cell_is_a_number_a_gap_or_a_fault(cell: str) -> None:
    body = HEADER + "".join(f"{1.6e9 + i:.0f},30000,1,2\n" for i in range(30)) + f"1600000100,30000,{cell},2\n"
    try:
        samples = read_samples(body.encode())
    except InputError:
        return
    assert len(samples) >= 30

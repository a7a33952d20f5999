"""Declared forms of time: each against datetime's arithmetic, and what is said of one that is not declared."""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magcal_core.errors import InputError, OptionError, TelemetryFormatError, TimeError, TimeZoneMissingError
from magcal_core.telemetry import read_samples
from magcal_core.telemetry.time_forms import COUNTS, WORDS

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
SENT = [datetime(2022, 2, 19, 22, 37, 44, 130001, tzinfo=UTC) + timedelta(seconds=10 * i) for i in range(12)]
WANTED = np.array([np.datetime64(t.replace(tzinfo=None), "ns") for t in SENT])
SPAN = ((WANTED[0], WANTED[0]),)
LEAP_S = 18
"""GPS minus UTC since 2017 (IERS Bulletin C)."""


def ns(t: datetime) -> int:
    return (t - EPOCH) // timedelta(microseconds=1) * 1000


def decimal(value: Fraction, places: int) -> str:
    whole = round(value * 10**places)
    return f"{whole // 10**places}.{whole % 10**places:0{places}d}" if places else str(whole)


def since(zero: str, unit_ns: int, places: int, plus_ns: int = 0) -> Callable[[datetime], str]:
    zero_ns = int(np.datetime64(zero, "ns").astype(np.int64))
    return lambda t: decimal(Fraction(ns(t) - zero_ns + plus_ns, unit_ns), places)


DAY = 86_400_000_000_000
TT_MINUS_UTC_NS = 69_184_000_000
"""In 2022: 32.184 s + 37 leap seconds."""
NUMBERS: dict[str, Callable[[datetime], str]] = {
    "unix-s": since("1970-01-01", 10**9, 6),
    "unix-ms": since("1970-01-01", 10**6, 3),
    "unix-us": since("1970-01-01", 1000, 0),
    "unix-ns": since("1970-01-01", 1, 0),
    "unix-days": since("1970-01-01", DAY, 14),
    "gps": since("1980-01-06", 10**9, 6, LEAP_S * 10**9),
    "j2000": since("2000-01-01T12:00", 10**9, 6),
    "j2000-tt": since("2000-01-01T12:00", 10**9, 6, TT_MINUS_UTC_NS),
    "jd": lambda t: decimal(Fraction(ns(t), DAY) + Fraction(4_881_175, 2), 14),
    "mjd": lambda t: decimal(Fraction(ns(t), DAY) + 40_587, 14),
    "excel": since("1899-12-30", DAY, 14),
}


def csv_of(times: list[str], head: str = "time") -> bytes:
    return "\n".join([f"{head},bx,by,bz", *(f"{t},30000,1,2" for t in times)]).encode()


def test_every_form_of_one_number_is_tried_here() -> None:
    assert set(NUMBERS) == set(COUNTS)


@pytest.mark.parametrize("name", sorted(NUMBERS))
@pytest.mark.parametrize("is_by_map", [False, True])
def test_numbers_of_a_declared_form_are_the_instants_to_the_nanosecond(name: str, is_by_map: bool) -> None:
    """Text is read exactly: 14 decimals of a day are a nanosecond."""
    times = [NUMBERS[name](t) for t in SENT]
    if is_by_map:
        samples = read_samples(csv_of(times, "met"), columns={f"time_{name.replace('-', '_')}": "met"})
    else:
        samples = read_samples(csv_of(times), time_format=name)
    assert np.abs((samples.t_utc - WANTED).astype(np.int64)).max() <= 1


@pytest.mark.parametrize("name", sorted(NUMBERS))
def test_the_other_formats_carry_the_same_forms(name: str) -> None:
    """JSON has doubles: a Julian day is then known to 40 us, seconds and whole numbers to the microsecond."""
    tolerance_ns = 50_000 if name.endswith("d") else 1000
    times = [json.loads(NUMBERS[name](t)) for t in SENT]
    rows = [{"time": t, "bx": 3e4, "by": 1.0, "bz": 2.0} for t in times]
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    table = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), table)
    bodies = {
        "ndjson": "\n".join(map(json.dumps, rows)).encode(),
        "json": json.dumps(columns).encode(),
        "parquet": bytes(table.getvalue()),
    }
    for kind, body in [*bodies.items(), ("json", json.dumps(rows).encode())]:
        samples = read_samples(body, format=kind, time_format=name)
        assert np.abs((samples.t_utc - WANTED).astype(np.int64)).max() <= tolerance_ns, kind


@given(st.integers(10**17, 4 * 10**18))
def test_nanoseconds_since_1970_keep_every_digit(t_ns: int) -> None:
    for body in (csv_of([str(t_ns)]), json.dumps({"time": [t_ns], "bx": [3e4], "by": [1], "bz": [2]}).encode()):
        assert int(read_samples(body, time_format="ns").t_utc[0].astype(np.int64)) == t_ns


@pytest.mark.parametrize(
    "pattern",
    ["%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%jT%H:%M:%S.%fZ", "%Y%m%dT%H%M%S.%fZ", "%Y%jT%H%M%S.%fZ", "%G-W%V-%uT%H:%M:%S.%fZ",
     "%GW%V%uT%H%M%S.%fZ", "%Y-%m-%d %H:%M:%S,%f+00:00", "%Y-%m-%d %H:%M:%S.%f UTC"],
)  # fmt: skip
def test_calendar_ordinal_and_week_dates_of_iso_8601_need_no_declaration(pattern: str) -> None:
    text = "".join(f'"{t.strftime(pattern)}",30000,1,2\n' for t in SENT)
    np.testing.assert_array_equal(read_samples(f"time,bx,by,bz\n{text}".encode()).t_utc, WANTED)


@pytest.mark.parametrize(
    "text", ["2022-366T00:00:00Z", "2022-000T00:00:00Z", "20220230T000000Z", "2022-W53-1T00:00:00Z"]
)
def test_dates_that_do_not_exist_are_refused_with_their_value(text: str) -> None:
    with pytest.raises(TimeError, match=rf"no such time: .*'{text}'"):
        read_samples(csv_of([text]))


@pytest.mark.parametrize(
    "pattern",
    [f"{day} %H:%M:%S.%f" for day in ("%d.%m.%Y", "%m/%d/%Y", "%d-%b-%Y", "%Y/%m/%d", "%d %b %Y")],
)
def test_a_text_of_another_form_is_refused_with_its_pattern_and_read_where_it_is_declared(pattern: str) -> None:
    body = csv_of([t.strftime(pattern) for t in SENT])
    for spans in ((), SPAN):
        with pytest.raises(TimeError) as caught:
            read_samples(body, orbit_spans=spans)
        assert f'--time-format "{pattern}"' in caught.value.message
        assert repr(SENT[0].strftime(pattern)) in caught.value.message
    np.testing.assert_array_equal(read_samples(body, time_format=pattern).t_utc, WANTED)


def test_of_two_readings_of_a_date_the_one_near_the_orbit_is_named() -> None:
    body = csv_of(["03/04/2022 22:37:44"])
    near = ((np.datetime64("2022-03-05"), np.datetime64("2022-03-05")),)
    with pytest.raises(TimeError) as caught:
        read_samples(body)
    assert "%d/%m/%Y" in caught.value.message
    assert "%m/%d/%Y" in caught.value.message
    with pytest.raises(TimeError) as caught:
        read_samples(body, orbit_spans=near)
    assert "%d/%m/%Y" not in caught.value.message
    assert '--time-format "%m/%d/%Y %H:%M:%S"' in caught.value.message


def test_a_time_without_a_zone_is_utc_where_it_is_declared() -> None:
    texts = [t.strftime("%Y-%m-%d %H:%M:%S.%f") for t in SENT]
    rows = [{"time": t, "bx": 3e4, "by": 1.0, "bz": 2.0} for t in texts]
    table = pa.BufferOutputStream()
    pq.write_table(pa.table({"time": WANTED, "bx": [3e4] * 12, "by": [1.0] * 12, "bz": [2.0] * 12}), table)
    bodies = [
        csv_of(texts),
        "\n".join(map(json.dumps, rows)).encode(),
        json.dumps(rows).encode(),
        json.dumps({key: [row[key] for row in rows] for key in rows[0]}).encode(),
        bytes(table.getvalue()),
    ]
    for body in bodies:
        with pytest.raises(TimeZoneMissingError):
            read_samples(body)
        np.testing.assert_array_equal(read_samples(body, time_format="utc").t_utc, WANTED)
    with pytest.raises(TimeZoneMissingError, match="where such times are UTC: --time-format utc"):
        read_samples(bodies[0])


def test_a_zone_that_is_there_counts_also_where_none_is_utc() -> None:
    body = csv_of([t.astimezone(UTC).isoformat().replace("+00:00", "+02:00") for t in SENT])
    assert (read_samples(body, time_format="utc").t_utc == WANTED - np.timedelta64(2, "h")).all()


def weeks(t: datetime) -> tuple[int, str]:
    gps_ns = ns(t) - int(np.datetime64("1980-01-06", "ns").astype(np.int64)) + LEAP_S * 10**9
    return gps_ns // (7 * DAY), decimal(Fraction(gps_ns % (7 * DAY), 10**9), 6)


def in_columns(head: str, *cells: Callable[[datetime], str]) -> bytes:
    rows = (",".join([*(cell(t) for cell in cells), "30000,1,2"]) for t in SENT)
    return "\n".join([f"{head},bx,by,bz", *rows]).encode()


def test_gps_weeks_and_seconds_stand_in_two_columns() -> None:
    cells = (lambda t: str(weeks(t)[0]), lambda t: weeks(t)[1])
    by_form = read_samples(in_columns("gps_week,gps_seconds", *cells), time_format="gps-week")
    by_map = read_samples(in_columns("WN,TOW", *cells), columns={"gps_week": "WN", "gps_seconds": "TOW"})
    np.testing.assert_array_equal(by_form.t_utc, WANTED)
    np.testing.assert_array_equal(by_map.t_utc, WANTED)
    with pytest.raises(TimeError, match="want a week of 0 to 10000 and seconds of 0 to 604800"):
        read_samples(in_columns("gps_week,gps_seconds", lambda t: "2197", lambda t: "700000"), time_format="gps-week")
    with pytest.raises(TelemetryFormatError, match="column TOW: missing: the times are GPS week and seconds"):
        read_samples(in_columns("WN,SOW", *cells), columns={"gps_week": "WN", "gps_seconds": "TOW"})


@pytest.mark.parametrize(
    ("day", "clock", "form"),
    [
        ("%Y-%m-%d", "%H:%M:%S.%f", None),
        ("%Y%m%d", "%H%M%S.%f", None),
        ("%Y-%j", "%H:%M:%S.%f", "date-time"),
        ("%d.%m.%Y", "%H:%M:%S.%f", "%d.%m.%Y %H:%M:%S.%f"),
    ],
)
def test_date_and_time_stand_in_two_columns(day: str, clock: str, form: str | None) -> None:
    body = in_columns("Day,Clock", lambda t: t.strftime(day), lambda t: t.strftime(clock))
    samples = read_samples(body, columns={"date": "Day", "time": "Clock"}, time_format=form)
    np.testing.assert_array_equal(samples.t_utc, WANTED)


def test_a_date_in_two_columns_that_needs_a_pattern_is_refused_with_it() -> None:
    body = in_columns("Day,Clock", lambda t: t.strftime("%d.%m.%Y"), lambda t: t.strftime("%H:%M:%S"))
    with pytest.raises(TimeError, match=r'--time-format "%d\.%m\.%Y %H:%M:%S"'):
        read_samples(body, columns={"date": "Day", "time": "Clock"})


def test_a_time_of_day_alone_is_refused_with_the_column_of_its_date() -> None:
    body = in_columns("Date,time", lambda t: t.strftime("%Y-%m-%d"), lambda t: t.strftime("%H:%M:%S"))
    with pytest.raises(TimeError, match=r'a time of day alone: .* column map \{"date": \.\., "time": \.\.\}'):
        read_samples(body)
    named = in_columns("Date,Time", lambda t: t.strftime("%Y-%m-%d"), lambda t: t.strftime("%H:%M:%S"))
    with pytest.raises(TelemetryFormatError, match=r'column map \{"time": "Time", "date": "Date"\}'):
        read_samples(named)


def part_of_day(t: datetime) -> Fraction:
    return Fraction(ns(t) % DAY, DAY)


@pytest.mark.parametrize(
    "cell",
    [
        lambda t: t.strftime("%Y:%j:%H:%M:%S.%f"),
        lambda t: t.strftime("%Y/%j %H:%M:%S.%f"),
        lambda t: t.strftime("%Y-%jT%H:%M:%S.%fZ"),
        lambda t: t.strftime("%Y.%j.%H.%M.%S.%f"),
        lambda t: decimal(int(t.strftime("%Y%j")) + part_of_day(t), 14),
        lambda t: decimal(int(t.strftime("%y%j")) + part_of_day(t), 14),
    ],
)
def test_days_of_the_year_are_read_in_every_usual_form(cell: Callable[[datetime], str]) -> None:
    samples = read_samples(csv_of([cell(t) for t in SENT]), time_format="doy")
    assert np.abs((samples.t_utc - WANTED).astype(np.int64)).max() <= 1


def test_a_day_of_the_year_alone_has_its_year_from_an_epoch_or_a_column() -> None:
    day = lambda t: decimal(int(t.strftime("%j")) + part_of_day(t), 14)  # noqa: E731
    body = csv_of([day(t) for t in SENT])
    epoch = read_samples(body, time_format="doy", time_epoch="2022-01-01T00:00:00Z")
    column = read_samples(in_columns("y,d", lambda t: str(t.year), day), columns={"year": "y", "day_of_year": "d"})
    clock = read_samples(
        in_columns("y,d,c", lambda t: str(t.year), lambda t: t.strftime("%j"), lambda t: t.strftime("%H:%M:%S.%f")),
        columns={"year": "y", "day_of_year": "d", "time": "c"},
    )
    for samples in (epoch, column, clock):
        assert np.abs((samples.t_utc - WANTED).astype(np.int64)).max() <= 1
    with pytest.raises(TimeError, match="a day of the year without a year: --time-epoch gives it"):
        read_samples(body, time_format="doy")


def test_seconds_since_boot_count_from_their_epoch() -> None:
    body = csv_of([decimal(Fraction(ns(t) - ns(SENT[0]), 10**9) + 600, 6) for t in SENT])
    boot = (SENT[0] - timedelta(seconds=600)).isoformat()
    np.testing.assert_array_equal(read_samples(body, time_format="boot", time_epoch=boot).t_utc, WANTED)
    with pytest.raises(OptionError, match="--time-epoch"):
        read_samples(body, time_format="boot")
    with pytest.raises(TimeError, match=r"seconds since boot \(with an epoch\)\? --time-format boot --time-epoch"):
        read_samples(body)


@pytest.mark.parametrize("name", sorted(set(NUMBERS) - {"unix-s", "gps", "j2000", "j2000-tt"}))
def test_numbers_that_are_not_declared_are_refused_with_the_one_form_near_the_orbit(name: str) -> None:
    with pytest.raises(TimeError) as caught:
        read_samples(csv_of([NUMBERS[name](t) for t in SENT]), orbit_spans=SPAN)
    assert caught.value.message.count("--time-format") == 1
    assert f"{WORDS[name]}? --time-format {name} (within three days of the orbit)" in caught.value.message


def test_numbers_that_no_form_puts_near_the_orbit_are_refused_in_these_words() -> None:
    with pytest.raises(TimeError, match="no form that is known puts them within three days of the orbit"):
        read_samples(csv_of(["1e15"]), orbit_spans=((np.datetime64("2022-02-19"), np.datetime64("2022-02-19")),))


@pytest.mark.parametrize(
    ("asked", "match"),
    [
        ({"time_format": "tai64"}, "unknown time format 'tai64'; known are unix-s, "),
        ({"time_format": "%H:%M"}, "a pattern of times needs a day"),
        ({"time_format": "unix-ms", "time_epoch": "2022-02-19T00:00:00Z"}, "belongs to the time formats boot and doy"),
        ({"time_format": "boot", "time_epoch": "yesterday"}, "time epoch 'yesterday': not an ISO 8601 time"),
        ({"time_format": "mjd", "columns": {"time_j2000": "time"}}, "the column map has the times as J2000 seconds"),
    ],
)
def test_a_form_that_cannot_be_is_refused(asked: dict[str, object], match: str) -> None:
    with pytest.raises(OptionError, match=match):
        read_samples(csv_of(["1645310264"]), **asked)  # type: ignore[arg-type]


def test_a_cell_that_is_not_of_the_declared_form_is_named_by_line_with_its_value() -> None:
    times = [NUMBERS["mjd"](t) for t in SENT]
    times[4] = "59,6x"
    body = csv_of(times).replace(b"59,6x", b'"59,6x"')
    with pytest.raises(TimeError) as caught:
        read_samples(body, time_format="mjd")
    assert [(fault.where, fault.value) for fault in caught.value.faults] == [("line 6, column time", "59,6x")]
    assert "not a number (modified Julian days): '59,6x'" in caught.value.message


@given(st.text(max_size=30), st.sampled_from([*WORDS, "%d.%m.%Y %H:%M"]))
def test_no_cell_whatever_escapes_as_another_error(cell: str, name: str) -> None:
    epoch = "2022-01-01T00:00:00Z" if name == "boot" else None
    body = json.dumps([{"time": t, "date": t, "gps_week": t, "gps_seconds": t, "bx": 3e4, "by": 1, "bz": 2}
                       for t in (cell, 5, 1e300, None)]).encode()  # fmt: skip
    try:
        read_samples(body, time_format=name, time_epoch=epoch, max_bad_fraction=1.0)
    except InputError:
        return

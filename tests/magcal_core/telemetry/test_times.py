"""Times: zones, epochs, leap seconds, wrong units; compared with the standard library's datetime and with erfa."""

from datetime import UTC, datetime, timedelta, timezone
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magcal_core.errors import OptionError, TimeError, TimeZoneMissingError
from magcal_core.telemetry import read_samples, read_telemetry
from magcal_core.telemetry.iso_times import parse_iso_ns

ROW = ",30000,1,2\n"


def table(*times: object) -> bytes:
    return ("time,bx,by,bz\n" + "".join(f"{t}{ROW}" for t in times)).encode()


def ns(samples_times: np.ndarray[tuple[int], np.dtype[np.datetime64]]) -> list[int]:
    return [int(v) for v in samples_times.astype(np.int64)]


instants = st.datetimes(
    min_value=datetime(1972, 1, 2),  # noqa: DTZ001 - hypothesis adds the zone
    max_value=datetime(2099, 12, 30),  # noqa: DTZ001
    timezones=st.just(UTC),
)
zones = st.integers(-14 * 60, 14 * 60).map(lambda minutes: timezone(timedelta(minutes=minutes)))


def exact_ns(instant: datetime) -> int:
    return (instant - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


@given(st.lists(st.tuples(instants, zones), min_size=1, max_size=8, unique_by=lambda pair: pair[0]))
def test_iso_times_of_any_zone_are_the_instants_that_datetime_says(pairs: list[tuple[datetime, timezone]]) -> None:
    samples = read_samples(table(*(instant.astimezone(zone).isoformat() for instant, zone in pairs)))
    assert ns(samples.t_utc) == sorted(exact_ns(instant) for instant, _ in pairs)


@given(instants, zones)
def test_the_slow_parser_agrees_with_datetime(instant: datetime, zone: timezone) -> None:
    assert parse_iso_ns(instant.astimezone(zone).isoformat()) == exact_ns(instant)


@given(st.lists(st.integers(10**14, 4 * 10**15), min_size=1, max_size=8, unique=True))
def test_epoch_seconds_keep_their_microseconds(micros: list[int]) -> None:
    samples = read_samples(table(*(f"{m // 10**6}.{m % 10**6:06d}" for m in micros)))
    assert ns(samples.t_utc) == sorted(1000 * m for m in micros)


def test_nanoseconds_of_iso_times_are_kept() -> None:
    samples = read_samples(table("2022-02-19T22:37:44.123456789Z"))
    assert samples.t_utc[0] == np.datetime64("2022-02-19T22:37:44.123456789")


@pytest.mark.parametrize("text", ["2022-02-19T22:37:44", "2022-02-19 22:37:44.5", "2022-10-30T02:30:00"])
def test_a_time_without_a_zone_is_refused(text: str) -> None:
    with pytest.raises(TimeZoneMissingError) as caught:
        read_samples(table("2022-02-19T22:37:43Z", text))
    assert [fault.where for fault in caught.value.faults] == ["line 3, column time"]


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("2016-12-31T23:59:60Z", "2017-01-01T00:00:00"),
        ("2016-12-31T23:59:60.25Z", "2017-01-01T00:00:00.25"),
        ("2017-01-01T01:59:60+02:00", "2017-01-01T00:00:00"),
    ],
)
def test_a_leap_second_counts_as_the_next_second(text: str, utc: str) -> None:
    assert read_samples(table(text)).t_utc[0] == np.datetime64(utc)


@pytest.mark.parametrize(
    "text",
    [
        "2022-02-30T00:00:00Z",
        "2022-13-01T00:00:00Z",
        "2022-02-19T24:00:00Z",
        "2022-02-19T22:60:00Z",
        "2022-02-19T22:37:60Z",
        "2022-02-19T22:37:61Z",
        "2022-02-19T22:37:44+25:00",
        "2022-02-19T22:37:44+02:75",
        "yesterday",
        "19/02/2022 22:37:44",
    ],
)
def test_times_that_do_not_exist_are_faults(text: str) -> None:
    with pytest.raises(TimeError) as caught:
        read_samples(table("2022-02-19T22:37:43Z", text))
    assert caught.value.faults[0].where == "line 3, column time"


def test_epoch_seconds_among_iso_times_are_faults_and_the_other_way_round() -> None:
    with pytest.raises(TimeError, match="epoch seconds in a column of ISO"):
        read_samples(table("2022-02-19T22:37:43Z", "1645310264"))
    with pytest.raises(TimeError, match="ISO 8601 time in a column of epoch"):
        read_samples(table("1645310264", "2022-02-19T22:37:43Z"))


@pytest.mark.parametrize(
    ("value", "unit"),
    [
        ("1645310264000", "milliseconds"),
        ("1645310264000000", "microseconds"),
        ("1645310264000000000", "nanoseconds"),
        ("59629.94", "modified Julian days"),
        ("2459630.44", "Julian days"),
        ("19042.9", "days since 1970"),
        ("12.5", "no seconds since"),
        ("-5", "no seconds since"),
        ("4291747200", "no seconds since"),
    ],
)
def test_numbers_in_another_unit_are_refused_with_the_unit_they_seem_to_have(value: str, unit: str) -> None:
    with pytest.raises(TimeError, match=unit):
        read_samples(table(value))


@pytest.mark.parametrize("year", ["1970", "2106", "9999"])
def test_implausible_years_are_refused(year: str) -> None:
    with pytest.raises(TimeError, match="1972 to 2099"):
        read_samples(table("2022-02-19T22:37:43Z", f"{year}-01-01T00:00:00Z"))


def test_unsorted_rows_give_what_sorted_rows_give_and_are_counted() -> None:
    rng = np.random.default_rng(5)
    lines = [f"{1_600_000_000 + 10 * i},{v}" for i, v in enumerate(["30000,1,2", *["31000,3,4"] * 40])]
    shuffled = [lines[i] for i in rng.permutation(len(lines))]
    want = read_telemetry(("time,bx,by,bz\n" + "\n".join(lines)).encode())
    got = read_telemetry(("time,bx,by,bz\n" + "\n".join(shuffled)).encode())
    assert got.quality.rows_out_of_order > 0 == want.quality.rows_out_of_order
    assert got.samples.t_utc.tobytes() == want.samples.t_utc.tobytes()
    assert got.samples.h_nt.tobytes() == want.samples.h_nt.tobytes()


@pytest.mark.parametrize(
    ("utc", "leap_s"), [("2022-02-19T22:37:44", 18), ("2016-12-31T23:59:59", 17), ("2017-01-01", 18)]
)
def test_gps_time_is_converted_where_it_is_declared(utc: str, leap_s: int) -> None:
    """GPS minus UTC was 17 s until the end of 2016 and is 18 s since (IERS Bulletin C)."""
    gps = np.datetime64(utc, "s") + np.timedelta64(leap_s, "s")
    seconds = int((gps - np.datetime64("1980-01-06", "s")).astype(int))
    for cell in (f"{gps}Z", str(seconds)):
        assert read_samples(table(cell), time_scale="gps").t_utc[0] == np.datetime64(utc)


@pytest.mark.parametrize(("scale", "ahead_ms"), [("tai", 37_000), ("tt", 69_184)])
def test_tai_and_tt_are_converted_where_they_are_declared(scale: str, ahead_ms: int) -> None:
    """TAI minus UTC is 37 s since 2017 (IERS Bulletin C), TT is 32.184 s ahead of TAI."""
    own = np.datetime64("2022-02-19T22:37:44", "ms") + np.timedelta64(ahead_ms, "ms")
    seconds = own.astype("M8[ms]").astype(np.int64) / 1e3
    for cell in (f"{own}Z", f"{seconds:.3f}"):
        found = read_samples(table(cell), time_scale=scale).t_utc[0]
        assert abs(found - np.datetime64("2022-02-19T22:37:44")) <= np.timedelta64(1, "us")


def test_an_unknown_time_scale_is_an_option_fault() -> None:
    with pytest.raises(OptionError, match="utc, gps, tai, tt"):
        read_samples(table("1645310264"), time_scale="tcb")


def test_a_float_epoch_is_rounded_to_the_microsecond() -> None:
    exact = Fraction("1645310264.123457")
    assert ns(read_samples(table("1645310264.1234567")).t_utc) == [int(exact * 10**9)]

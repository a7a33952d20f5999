"""Spans of time left out, times of another scale, and the stretches that a loss rejects."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.data_quality import rejected_stretches
from magcal_core.errors import InputError, OptionError, TimeError, TooFewSamplesError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.reference.rows_asked_for import rows_asked_for
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of
from magcal_core.telemetry.spans import in_spans, parse_span
from magcal_core.telemetry.times import in_utc_ns

BEGIN = np.datetime64("2026-11-29T03:00:00", "ns")
SPAN = "2026-11-29T03:30:00Z/2026-11-29T03:50:00Z"


def seconds(count: int) -> np.ndarray:
    return BEGIN + np.arange(count) * np.timedelta64(1, "s")


def plain(count: int) -> Samples:
    return Samples(seconds(count), np.ones((count, 3)))


def test_a_span_holds_its_first_time_and_not_its_last() -> None:
    inside = in_spans(seconds(3600), [parse_span(SPAN)])
    assert np.flatnonzero(inside)[[0, -1]].tolist() == [1800, 2999]
    kept = rows_asked_for(plain(3600), CalibrationOptions(without=(SPAN,)))
    np.testing.assert_array_equal(kept.t_utc, np.delete(seconds(3600), np.arange(1800, 3000)))


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("2026-11-29T03:30:00Z", TimeError),
        ("2026-11-29T03:30:00/2026-11-29T03:50:00", TimeError),
        ("2026-11-29T03:30:00Z/2026-11-29T03:50:00Z/2026-11-29T04:00:00Z", TimeError),
        ("half past three/four", TimeError),
        ("2026-11-29T03:50:00Z/2026-11-29T03:30:00Z", OptionError),
        ("2026-11-29T03:50:00Z/2026-11-29T03:50:00Z", OptionError),
    ],
)
def test_what_is_no_span_is_refused(text: str, error: type[InputError]) -> None:
    with pytest.raises(error):
        parse_span(text)
    with pytest.raises(OptionError, match=r"^without: "):
        CalibrationOptions(without=(text,))


def test_spans_that_leave_nothing_are_refused() -> None:
    with pytest.raises(TooFewSamplesError, match="hold every sample"):
        rows_asked_for(plain(100), CalibrationOptions(without=("2026-11-29T00:00:00Z/2026-11-30T00:00:00Z",)))


@pytest.mark.parametrize(
    ("scale", "own", "utc"),
    [
        ("gps", "2016-12-31T23:59:59", "2016-12-31T23:59:42"),
        ("gps", "2017-01-01T00:00:18", "2017-01-01T00:00:00"),
        ("tai", "2017-01-01T00:00:37", "2017-01-01T00:00:00"),
        ("tai", "2016-12-31T23:59:59", "2016-12-31T23:59:23"),
        ("tt", "2026-11-29T03:01:09.184", "2026-11-29T03:00:00"),
    ],
)
def test_other_scales_are_ahead_of_utc_by_what_the_bulletins_say(scale: str, own: str, utc: str) -> None:
    """IERS Bulletin C 52: TAI - UTC is 36 s until 2017-01-01, then 37 s. GPS is TAI - 19 s, TT is TAI + 32.184 s."""
    t_ns = np.array([np.datetime64(own, "ns")]).view(np.int64)
    found = in_utc_ns(t_ns, scale).view("datetime64[ns]")
    assert found[0] == np.datetime64(utc, "ns")


def test_the_spans_left_out_are_utc_also_where_the_clock_keeps_another_scale() -> None:
    late = replace(plain(3600), t_utc=seconds(3600) + np.timedelta64(37, "s"))
    kept = rows_asked_for(late, CalibrationOptions(without=(SPAN,), time_scale="tai"))
    np.testing.assert_array_equal(kept.t_utc, np.delete(seconds(3600), np.arange(1800, 3000)))


def test_windows_of_a_session_have_its_times_moved_and_its_spans_left_out_once() -> None:
    session = SESSIONS[0]
    flown = simulated(session, 2100).samples
    late = replace(flown, t_utc=flown.t_utc + np.timedelta64(18, "s"))
    orbits = [Sgp4Orbit(tle_of(session))]
    asked = {"windows": 1.9, "locked_terms": "none", "bias_steps": "none"}
    found = calibrate(late, orbits, time_scale="gps", **asked)
    truth = calibrate(flown, orbits, **asked)
    assert found.to_dict()["windows"] == truth.to_dict()["windows"]


def test_a_stretch_is_where_most_rows_are_rejected_and_its_ends_are_its_own() -> None:
    rng = np.random.default_rng(3)
    is_rejected = rng.random(5000) < 0.05
    is_rejected[2000:2600] = rng.random(600) < 0.8
    (found,) = rejected_stretches(seconds(5000), is_rejected)
    begin, end = ((one - BEGIN) / np.timedelta64(1, "s") for one in (found.begin, found.end))
    assert abs(begin - 2000) < 10 and abs(end - 2600) < 10
    assert found.samples == end - begin
    assert found.rejected == np.count_nonzero(is_rejected[int(begin) : int(end)])


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.45])
def test_rows_rejected_here_and_there_make_no_stretch(share: float) -> None:
    """200 sessions of 5,000 rows: none has one by chance."""
    rng = np.random.default_rng(11)
    for _ in range(200):
        assert rejected_stretches(seconds(5000), rng.random(5000) < share) == ()


def test_of_several_stretches_the_longest_come_first_and_none_twice() -> None:
    is_rejected = np.zeros(5000, bool)
    for begin, end in ((100, 200), (1000, 1400), (3000, 3250), (4000, 4050)):
        is_rejected[begin:end] = True
    found = rejected_stretches(seconds(5000), is_rejected)
    assert [one.samples for one in found] == [400, 250, 100]
    assert all(one.samples == one.rejected for one in found)


def test_a_span_may_reach_beyond_what_nanoseconds_can_count() -> None:
    begin, end = parse_span("0001-01-01T00:00:00Z/9999-12-31T23:59:59Z")
    assert (begin, end) == (np.datetime64(-(2**63 - 1), "ns"), np.datetime64(2**63 - 1, "ns"))
    with pytest.raises(OptionError):
        parse_span("9998-01-01T00:00:00Z/9999-01-01T00:00:00Z")

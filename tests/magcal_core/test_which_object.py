"""Which object of a launch a session is of: planted among objects along one track, and what cannot be told."""

import numpy as np
import pytest

from magcal_core.errors import InputError
from magcal_core.orbit.messages.tle import checksum
from magcal_core.orbit.sources import OrbitSource, parse_sources
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.which_object import which_object

FIRST, SECOND = (next(line for line in tle_text().splitlines() if line.startswith(f"{kind} ")) for kind in "12")
KM_PER_DEG = 2.0 * np.pi * 6_930.0 / 360.0


def object_tle(number: int, ahead_deg: float) -> str:
    """Return the satellite's TLE as that of an object so far ahead of it on the same track."""
    anomaly = (float(SECOND[43:51]) + ahead_deg) % 360.0
    lines = [f"1 {number:05d}{FIRST[7:68]}", f"2 {number:05d}{SECOND[7:43]}{anomaly:8.4f}{SECOND[51:68]}"]
    return "".join([f"OBJECT {number}\n", *(f"{line}{checksum(line)}\n" for line in lines)])


def launch(spacing_deg: float, own: int = 4, count: int = 8) -> list[OrbitSource]:
    """Return the orbits of a launch; the session's own is number 50000 + ``own``."""
    return parse_sources("".join(object_tle(50_000 + k, (k - own) * spacing_deg) for k in range(count)))


@pytest.fixture(scope="module")
def samples() -> Samples:
    """Noise of 100 nT along the demonstration's own orbit."""
    return simulated(SESSIONS[0], 500).samples


@pytest.mark.parametrize("own", [0, 5])
def test_the_object_is_told_among_others_forty_kilometres_apart(samples, own):
    found = which_object(samples, launch(40.0 / KM_PER_DEG, own))
    assert found.state == "told"
    assert found.objects[0].norad_id == str(50_000 + own)
    assert found.objects[0].behind_first is None
    assert all(one.behind_first is None or one.behind_first > 3.0 for one in found.objects[1:])
    assert f"{50_000 + own} OBJECT {50_000 + own} leaves" in found.text


def test_spikes_do_not_tell_of_another_object(samples):
    rng = np.random.default_rng(7)
    h_nt = samples.h_nt.copy()
    rows = rng.choice(len(h_nt), len(h_nt) // 20, replace=False)
    h_nt[rows] += rng.normal(0.0, 5e3, (len(rows), 3))
    found = which_object(Samples(t_utc=samples.t_utc, h_nt=h_nt), launch(60.0 / KM_PER_DEG))
    assert (found.state, found.objects[0].norad_id) == ("told", "50004")


@pytest.mark.parametrize("kind", ["stretch", "zeros", "spikes"])
def test_a_third_of_bad_rows_does_not_tell_of_another_object(samples, kind):
    rng = np.random.default_rng(11)
    h_nt, count = samples.h_nt.copy(), 3 * len(samples) // 10
    rows = rng.choice(len(h_nt), count, replace=False)
    if kind == "stretch":
        h_nt[60 : 60 + count] += [9e3, -5e3, 12e3]
    elif kind == "zeros":
        h_nt[rows] = 0.0
    else:
        h_nt[rows] += rng.normal(0.0, 3e4, (count, 3))
    found = which_object(Samples(t_utc=samples.t_utc, h_nt=h_nt), launch(60.0 / KM_PER_DEG, count=3, own=1))
    assert (found.state, found.objects[0].norad_id) == ("told", "50001"), found.text


def test_the_loss_is_that_of_a_calibration_by_default(samples):
    """Clean rows lose nothing: the residual is that of the plain fit, which every default calibration has there."""
    orbits = launch(60.0 / KM_PER_DEG, count=2, own=0)
    first = which_object(samples, orbits).objects[0]
    some = samples.take(np.linspace(0, len(samples) - 1, 400).astype(np.intp))
    bare = Samples(t_utc=some.t_utc, h_nt=some.h_nt)
    got = calibrate(bare, [orbits[0].orbit], noise_model="none", time_offset="none")
    assert (got.extras["robust"]["asked"], got.extras["robust"]["used"]) == ("auto", "none")
    assert first.residual_nt == pytest.approx(1.4826 * np.median(np.abs(got.residuals.residual_nt)), abs=1e-3)


def test_objects_some_kilometres_apart_are_the_same_for_a_magnetometer(samples):
    """3 km are 30 nT at the most, against 100 nT of noise."""
    found = which_object(samples, launch(3.0 / KM_PER_DEG, count=4, own=1))
    assert found.state == "ambiguous"
    assert "about as little" in found.text


def test_where_no_object_explains_the_session_none_is_named(samples):
    found = which_object(samples, launch(20.0, own=-3, count=4))
    assert found.state == "none"
    assert "none of the 4 objects explains the session" in found.text


def test_several_orbits_of_one_object_are_one(samples):
    doubled = [*launch(0.5, count=5), *launch(0.5, count=5)]
    assert len(which_object(samples, doubled).objects) == 5


def test_one_object_alone_is_no_question(samples):
    with pytest.raises(InputError, match="the orbits are of 1 objects; want 2 to 200"):
        which_object(samples, launch(1.0, count=1))


def test_an_orbit_that_is_too_old_has_its_reason(samples):
    old = Samples(t_utc=samples.t_utc + np.timedelta64(60, "D"), h_nt=samples.h_nt)
    found = which_object(old, launch(1.0, count=2))
    assert found.state == "none"
    assert all(one.reason is not None and one.reason.startswith("tle_epoch") for one in found.objects)

"""The field between nodes along an orbit against the field at every sample."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magcal_core.errors import ModelRangeError, OrbitMissingError
from magcal_core.field import FieldModel
from magcal_core.field.dipole import DirectDipole
from magcal_core.field.igrf import Igrf
from magcal_core.numerics.interpolation import StateTable
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.frames import itrf_to_gcrf, teme_to_itrf
from magcal_core.orbit.ephemeris.oem import OemOrbit, Segment
from magcal_core.orbit.messages.tle import checksum
from magcal_core.orbit.propagators.numerical import NumericalOrbit
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.columns import with_reference
from magcal_core.reference.field_along_orbit import field_along
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.reference.shifted_times import MovingReference
from magcal_core.samples import SampleFlag, Samples

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

FIELD = Igrf()
WITHIN_NT = 0.01
"""What is promised: a thousandth of what the quietest magnetometers show, and a tenth of what IGRF codes differ by."""
ORBITS = {
    "200 km": (51.6, 5, 90.0, 16.25),
    "200 km, polar": (90.0, 5, 90.0, 16.25),
    "200 km, against the Earth's rotation": (150.0, 5, 90.0, 16.25),
    "500 km, sun-synchronous": (97.4, 10000, 90.0, 15.2),
    "1200 km": (88.0, 10000, 90.0, 13.16),
    "transfer orbit": (7.0, 7000000, 178.0, 2.6),
    "transfer orbit, perigee at the pole": (90.0, 5500000, 90.0, 4.9),
}
"""Inclination, deg, eccentricity in 1e-7, argument of perigee, deg, turns a day."""


def _orbit(name: str, epoch: str = "22050.50000000") -> Sgp4Orbit:
    inclination_deg, eccentricity, perigee_deg, turns_day = ORBITS[name]
    angles = f"{inclination_deg:8.4f} 120.0000 {eccentricity:07d} {perigee_deg:8.4f}   0.0000"
    lines = (
        f"1 00001U          {epoch}  .00000000  00000-0  00000-0 0  999",
        f"2 00001 {angles} {turns_day:11.8f}    0",
    )
    return Sgp4Orbit.from_tle("\n".join(line.ljust(68) + str(checksum(line)) for line in lines))


def _every_sample(orbit: Sgp4Orbit, field: FieldModel, t_utc: Times) -> Floats:
    """The field, (n, 3), ITRF, nT, where SGP4 has the satellite at each time, by the slow reduction."""
    return field.field_itrf_nt(t_utc, teme_to_itrf(t_utc, orbit.state_teme(t_utc)[0]))


def _seconds(orbit: Orbit, t_s: Floats) -> Times:
    return orbit.epoch_utc + np.round(t_s * 1e9).astype("timedelta64[ns]")


def _reference(orbit: Orbit, t_utc: Times, q: Floats | None = None, field: FieldModel = FIELD) -> Samples:
    samples = Samples(t_utc, np.full((len(t_utc), 3), 2e4), q_base_gcrf=q)
    return with_reference(samples, [orbit], field, max_orbit_age_days=1e4)[0]


def _given(column: Floats | None) -> Floats:
    assert column is not None
    return column


def _attitudes(n: int) -> Floats:
    q = np.random.default_rng(4).normal(size=(n, 4))
    return np.asarray(q / np.linalg.norm(q, axis=1)[:, None])


def _turned(q: Floats, b_gcrf_nt: Floats) -> Floats:
    """Scipy turns vectors where the attitude turns axes."""
    return np.asarray(Rotation.from_quat(q, scalar_first=True).inv().apply(b_gcrf_nt))


def _oem(orbit: Orbit, step_s: float, hours: float, interpolation: str, degree: int) -> OemOrbit:
    t_utc = _seconds(orbit, np.arange(0.0, hours * 3600.0 + 1.0, step_s))
    stamps = t_utc.astype(np.int64)
    table = StateTable(stamps, *orbit.state_gcrf(t_utc))
    return OemOrbit((Segment("GCRF", table, int(stamps[0]), int(stamps[-1]), interpolation, degree),))


@pytest.mark.parametrize("name", ORBITS)
@pytest.mark.parametrize("step_s", [0.1, 1.0, 5.0])
def test_the_field_along_an_orbit_is_that_at_every_sample(name: str, step_s: float) -> None:
    """From before the perigee to behind it, within the five Earth radii that the model has, by component."""
    orbit = _orbit(name)
    t_utc = _seconds(orbit, np.arange(max(-4000, -7500 / step_s), min(8000, 7500 / step_s)) * step_s)
    along = field_along(orbit, FIELD, t_utc, is_gcrf=False)
    assert along is not None
    assert along.pieces.gap_fraction == 0.0
    np.testing.assert_allclose(along.at(t_utc), _every_sample(orbit, FIELD, t_utc), rtol=0, atol=WITHIN_NT)
    want_nt = np.linalg.norm(_every_sample(orbit, FIELD, t_utc), axis=1)
    np.testing.assert_allclose(_reference(orbit, t_utc).b_ref_magnitude_nt, want_nt, rtol=0, atol=WITHIN_NT)


@pytest.mark.parametrize("step_s", [10.0, 20.0])
def test_sparse_samples_have_the_field_of_their_own_position(step_s: float) -> None:
    """To rounding: nothing is interpolated that would cost more than it saves."""
    orbit = _orbit("500 km, sun-synchronous")
    t_utc = _seconds(orbit, np.arange(3000) * step_s)
    filled = _reference(orbit, t_utc)
    want_nt = np.linalg.norm(FIELD.field_itrf_nt(t_utc, _given(filled.r_itrf_km)), axis=1)
    np.testing.assert_allclose(filled.b_ref_magnitude_nt, want_nt, rtol=1e-14)
    assert field_along(orbit, FIELD, t_utc, is_gcrf=False) is None
    assert field_along(orbit, FIELD, _seconds(orbit, np.arange(999.0)), is_gcrf=False) is None


@pytest.mark.parametrize("field", [Igrf(max_degree=1), Igrf(13, 9, np.datetime64("2020-01-01")), DirectDipole()])
def test_other_models_are_met_as_well(field: FieldModel) -> None:
    orbit = _orbit("200 km, polar")
    t_utc = _seconds(orbit, np.arange(8000.0))
    along = field_along(orbit, field, t_utc, is_gcrf=False)
    assert along is not None
    np.testing.assert_allclose(along.at(t_utc), _every_sample(orbit, field, t_utc), rtol=0, atol=WITHIN_NT)


@pytest.mark.parametrize("epoch", ["20001.00000000", "25001.00000000"])
def test_polynomials_reach_across_the_knots_of_the_igrf(epoch: str) -> None:
    """Its slope steps there by some 20 nT a year: 0.0002 nT in the 6 minutes that a polynomial reaches."""
    orbit = _orbit("200 km", epoch)
    t_utc = _seconds(orbit, np.arange(-3000.0, 3000.0))
    along = field_along(orbit, FIELD, t_utc, is_gcrf=False)
    assert along is not None
    assert along.pieces.gap_fraction == 0.0
    np.testing.assert_allclose(along.at(t_utc), _every_sample(orbit, FIELD, t_utc), rtol=0, atol=WITHIN_NT)


def test_at_a_leap_second_each_sample_is_asked_for_itself() -> None:
    """The Earth is then a second, half a kilometre at 7000 km, away from where the clock would have it."""
    orbit = _orbit("500 km, sun-synchronous", "16366.50000000")
    t_utc = np.datetime64("2017-01-01", "ns") + np.arange(-3000, 3000).astype("timedelta64[s]")
    along = field_along(orbit, FIELD, t_utc, is_gcrf=False)
    assert along is not None
    assert 0.0 < along.pieces.gap_fraction < 0.2
    near = np.arange(2400, 3600)
    few = [t_utc[part] for part in np.split(near, 4)]  # so few that their positions are not interpolated either
    want_nt = np.concatenate([_every_sample(orbit, FIELD, part) for part in few])
    got_nt = np.concatenate([along.at(part) for part in few])
    np.testing.assert_allclose(got_nt, want_nt, rtol=0, atol=WITHIN_NT)


def test_order_gaps_and_repetition_change_nothing() -> None:
    rng = np.random.default_rng(0)
    orbit = _orbit("500 km, sun-synchronous")
    t_s = np.concatenate([rng.uniform(0, 8000, 4000), rng.uniform(700_000, 708_000, 4000)])
    t_utc = _seconds(orbit, rng.permutation(t_s))
    want_nt = np.linalg.norm(_every_sample(orbit, FIELD, t_utc), axis=1)
    found_nt = _given(_reference(orbit, t_utc).b_ref_magnitude_nt)
    np.testing.assert_allclose(found_nt, want_nt, rtol=0, atol=WITHIN_NT)
    twice = np.concatenate([t_utc, t_utc[:300]])
    np.testing.assert_array_equal(_given(_reference(orbit, twice).b_ref_magnitude_nt)[:8000], found_nt)
    np.testing.assert_array_equal(_reference(orbit, t_utc[::-1]).b_ref_magnitude_nt, found_nt[::-1])


def test_a_sample_has_the_same_field_whatever_surrounds_it() -> None:
    orbit = _orbit("200 km, polar")
    t_utc = _seconds(orbit, np.arange(6000.0))
    found_nt = _given(_reference(orbit, t_utc).b_ref_magnitude_nt)
    for some in (slice(None, None, 11), slice(500, 1700), slice(4000, None, 2)):
        alone_nt = _given(_reference(orbit, t_utc[some]).b_ref_magnitude_nt)
        np.testing.assert_allclose(alone_nt, found_nt[some], rtol=0, atol=WITHIN_NT)


@pytest.mark.parametrize(
    ("step_s", "interpolation", "degree"),
    [(60.0, "HERMITE", 7), (600.0, "HERMITE", 7), (60.0, "LAGRANGE", 7), (240.0, "LAGRANGE", 5), (30.0, "LINEAR", 1)],
)
def test_an_ephemeris_with_corners_is_followed_where_it_goes(step_s: float, interpolation: str, degree: int) -> None:
    """Up to both its ends, beyond which no node has a field; against its own positions at every sample."""
    oem = _oem(_orbit("500 km, sun-synchronous"), step_s, 3.0, interpolation, degree)
    t_utc = _seconds(oem, np.arange(0.0, 10_801.0))
    filled = _reference(oem, t_utc)
    want_nt = np.linalg.norm(FIELD.field_itrf_nt(t_utc, oem.position_itrf_km(t_utc)), axis=1)
    np.testing.assert_allclose(filled.b_ref_magnitude_nt, want_nt, rtol=0, atol=WITHIN_NT)
    if interpolation == "HERMITE" and step_s < 100:
        along = field_along(oem, FIELD, t_utc, is_gcrf=False)
        assert along is not None
        assert along.pieces.gap_fraction < 0.1


def test_a_numerical_orbit_is_interpolated_too() -> None:
    start = _orbit("500 km, sun-synchronous")
    (r_km,), (v_km_s,) = start.state_gcrf(_seconds(start, np.zeros(1)))
    orbit = NumericalOrbit(start.epoch_utc, r_km, v_km_s)
    t_utc = _seconds(orbit, np.arange(-2000.0, 4000.0))
    along = field_along(orbit, FIELD, t_utc, is_gcrf=False)
    assert along is not None
    assert along.pieces.gap_fraction == 0.0
    want_nt = FIELD.field_itrf_nt(t_utc, orbit.position_itrf_km(t_utc))
    np.testing.assert_allclose(along.at(t_utc), want_nt, rtol=0, atol=WITHIN_NT)


def test_the_field_in_the_base_frame_is_that_at_every_sample() -> None:
    """An attitude that is missing leaves only its own sample without."""
    orbit = _orbit("200 km, polar")
    t_utc, q = _seconds(orbit, np.arange(3000.0)), _attitudes(3000)
    q[7] = np.nan
    filled = _reference(orbit, t_utc, q)
    b_gcrf_nt = itrf_to_gcrf(t_utc, _every_sample(orbit, FIELD, t_utc))
    np.testing.assert_allclose(filled.b_ref_gcrf_nt, b_gcrf_nt, rtol=0, atol=WITHIN_NT)
    known = np.arange(3000) != 7
    b_base_nt = _given(filled.b_ref_base_nt)
    np.testing.assert_allclose(b_base_nt[known], _turned(q[known], b_gcrf_nt[known]), rtol=0, atol=WITHIN_NT)
    assert np.isnan(b_base_nt[7]).all()


def test_several_orbits_each_give_the_field_of_their_own_samples() -> None:
    orbits = [_orbit("500 km, sun-synchronous", epoch) for epoch in ("22050.50000000", "22051.50000000")]
    t_utc = _seconds(orbits[0], np.arange(38_000.0, 50_000.0))
    samples = Samples(t_utc, np.full((len(t_utc), 3), 2e4))
    filled, report = with_reference(samples, orbits, FIELD)
    assert [entry["samples"] for entry in report.orbits] == [5201, 6799]
    want_nt = np.linalg.norm(FIELD.field_itrf_nt(t_utc, _given(filled.r_itrf_km)), axis=1)
    np.testing.assert_allclose(filled.b_ref_magnitude_nt, want_nt, rtol=0, atol=WITHIN_NT)


def test_gaps_in_an_ephemeris_stay_gaps() -> None:
    oem = _oem(_orbit("500 km, sun-synchronous"), 60.0, 1.0, "HERMITE", 7)
    t_utc = _seconds(oem, np.arange(-500.0, 3000.0))
    filled = _reference(oem, t_utc)
    is_before = np.arange(3500) < 500
    np.testing.assert_array_equal(np.isnan(_given(filled.b_ref_magnitude_nt)), is_before)
    np.testing.assert_array_equal((filled.flags & SampleFlag.NO_REFERENCE) > 0, is_before)
    with pytest.raises(OrbitMissingError, match="500 of 3500"):
        MovingReference([oem], FIELD, is_gcrf=False).at(t_utc, None)


@pytest.mark.parametrize("shift_s", [-1800.3, 0.7, 55.5])
def test_a_shifted_reference_is_that_at_the_shifted_times(shift_s: float) -> None:
    orbit = _orbit("500 km, sun-synchronous")
    t_utc, q = _seconds(orbit, np.arange(4000.0)), _attitudes(4000)
    h_nt = np.random.default_rng(1).normal(size=(4000, 3)) * 2e4
    samples = Samples(t_utc, h_nt, q_base_gcrf=q, housekeeping={"temperature_c": np.arange(4000.0)})
    referenced = Referenced.of(samples, [orbit], CalibrationOptions())
    usable = np.arange(4000) >= 10
    later = _seconds(orbit, np.arange(10.0, 4000.0) + shift_s)
    want_nt = itrf_to_gcrf(later, _every_sample(orbit, FIELD, later))
    for rows in (slice(None), slice(None, None, 2)):
        moved = referenced.shifted(usable, ["temperature_c"], np.full(len(later[rows]), shift_s), rows)
        np.testing.assert_allclose(moved.b_nt, np.linalg.norm(want_nt[rows], axis=1), rtol=0, atol=WITHIN_NT)
        turned_nt = _turned(q[usable][rows], want_nt[rows])
        np.testing.assert_allclose(moved.b_base_nt, turned_nt, rtol=0, atol=WITHIN_NT)
        again = referenced.movable(usable, ["temperature_c"]).at(np.full(len(later[rows]), shift_s), rows)
        np.testing.assert_allclose(again.b_base_nt, moved.b_base_nt, rtol=0, atol=WITHIN_NT)
        unmoved = referenced.observations(usable, ["temperature_c"]).take(rows)
        np.testing.assert_array_equal(moved.t_s, unmoved.t_s)
        np.testing.assert_array_equal(moved.h_nt, unmoved.h_nt)
        np.testing.assert_array_equal(moved.regressors["temperature_c"], unmoved.regressors["temperature_c"])


@pytest.mark.parametrize("step_s", [10.0, 20.0])
def test_what_is_asked_for_again_and_again_is_interpolated_at_sparser_samples(step_s: float) -> None:
    """As a search for the clock does, at DEKART's 700 samples, within a minute of them and far from them."""
    orbit = _orbit("200 km, polar")
    t_utc, q = _seconds(orbit, np.arange(700) * step_s), _attitudes(700)
    reference = MovingReference.about(t_utc, [orbit], FIELD, is_gcrf=True, uses=4)
    assert reference.along is not None
    for shift_s in (-1000.0, -30.0, 0.0, 0.5, 50.0):
        later = t_utc + np.timedelta64(round(shift_s * 1e9), "ns")
        want_nt = itrf_to_gcrf(later, _every_sample(orbit, FIELD, later))
        magnitude_nt, b_base_nt = reference.at(later, q)
        np.testing.assert_allclose(magnitude_nt, np.linalg.norm(want_nt, axis=1), rtol=0, atol=WITHIN_NT)
        np.testing.assert_allclose(b_base_nt, _turned(q, want_nt), rtol=0, atol=WITHIN_NT)


def test_samples_beyond_the_model_are_left_out_dense_or_not_and_the_others_have_their_field() -> None:
    """Five Earth radii lie between the perigee and the apogee of a transfer orbit.

    At times that move there is no sample to leave out: they are asked for with the far ones out, and else refused.
    """
    orbit = _orbit("transfer orbit")
    t_utc = _seconds(orbit, np.arange(0.0, 15_000.0))
    for some in (t_utc, t_utc[::60]):
        r_km = np.linalg.norm(orbit.state_teme(some)[0], axis=1)
        is_beyond = r_km > 31_856.0
        assert 0 < np.count_nonzero(is_beyond) < len(some)
        filled = _reference(orbit, some)
        magnitude_nt = _given(filled.b_ref_magnitude_nt)
        np.testing.assert_array_equal(np.isnan(magnitude_nt), is_beyond)
        want_nt = np.linalg.norm(_every_sample(orbit, FIELD, some[~is_beyond]), axis=1)
        np.testing.assert_allclose(magnitude_nt[~is_beyond], want_nt, rtol=0, atol=WITHIN_NT)
        is_weak = magnitude_nt < np.nanmax(magnitude_nt) / 20.0
        is_far = (filled.flags & np.uint16(SampleFlag.FAR)) > 0
        np.testing.assert_array_equal(is_far, is_beyond | is_weak)
        with pytest.raises(ModelRangeError, match="to 31856 km"):
            MovingReference.about(some, [orbit], FIELD, is_gcrf=False, uses=4).at(some, None)


def test_where_every_sample_is_beyond_the_model_it_is_refused() -> None:
    orbit = _orbit("transfer orbit")
    t_utc = _seconds(orbit, np.arange(14_000.0, 16_000.0, 60.0))
    assert np.all(np.linalg.norm(orbit.state_teme(t_utc)[0], axis=1) > 31_856.0)
    with pytest.raises(ModelRangeError, match="to 31856 km"):
        _reference(orbit, t_utc)


def test_the_last_samples_within_a_model_need_no_node_beyond_it() -> None:
    """IGRF-13 ends with 2024."""
    orbit = _orbit("500 km, sun-synchronous", "24366.50000000")
    until = np.datetime64("2025-01-01", "ns")
    t_utc = until - np.arange(3000)[::-1].astype("timedelta64[s]")
    filled = _reference(orbit, t_utc, field=Igrf(13))
    want_nt = np.linalg.norm(_every_sample(orbit, Igrf(13), t_utc), axis=1)
    np.testing.assert_allclose(filled.b_ref_magnitude_nt, want_nt, rtol=0, atol=WITHIN_NT)
    with pytest.raises(ModelRangeError):
        _reference(orbit, t_utc + np.timedelta64(1, "s"), field=Igrf(13))

"""The reference columns, whatever they are made from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.errors import ModelRangeError, OrbitMissingError, TleEpochError
from magcal_core.field.dipole import DirectDipole
from magcal_core.field.igrf import Igrf
from magcal_core.orbit.earth.frames import itrf_to_gcrf
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.columns import with_reference
from magcal_core.samples import SampleFlag, Samples

Floats = NDArray[np.float64]
FIELD = Igrf()


@pytest.fixture(scope="module")
def orbits(data_dir: Path) -> list[Sgp4Orbit]:
    return [Sgp4Orbit(tle) for tle in parse_tles((data_dir / "dekart.tle.txt").read_text())]


@pytest.fixture(scope="module")
def samples(orbits: list[Sgp4Orbit]) -> Samples:
    t_utc = orbits[0].epoch_utc + (np.arange(200) * 30).astype("timedelta64[s]")
    return Samples(t_utc=t_utc, h_nt=np.full((200, 3), 2e4))


def _given(column: Floats | None) -> Floats:
    assert column is not None
    return column


def _quaternions(n: int) -> Floats:
    q = np.random.default_rng(4).normal(size=(n, 4))
    return np.asarray(q / np.linalg.norm(q, axis=1)[:, None])


def _turn(q: Floats, v: Floats) -> Floats:
    """v_base = C v_gcrf with C = (w^2 - |q|^2) I + 2 q q^T - 2 w [q x], written out row by row."""
    turned = []
    for (w, *part), vector in zip(q, v, strict=True):
        axis = np.array(part)
        turned.append((w * w - axis @ axis) * vector + 2 * axis * (axis @ vector) - 2 * w * np.cross(axis, vector))
    return np.array(turned)


def test_orbit_and_model_give_the_magnitude_and_the_position(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    filled, report = with_reference(samples, orbits[:1], FIELD)
    r_km = orbits[0].position_itrf_km(samples.t_utc)
    np.testing.assert_array_equal(filled.r_itrf_km, r_km)
    want_nt = np.linalg.norm(FIELD.field_itrf_nt(samples.t_utc, r_km), axis=1)
    np.testing.assert_allclose(_given(filled.b_ref_magnitude_nt), want_nt, rtol=1e-14)
    assert filled.b_ref_base_nt is None
    assert (report.orbit_model, report.field_model, report.warnings) == ("sgp4", "igrf-14", ())
    (entry,) = report.orbits
    assert entry == {
        "index": 0,
        "model": "sgp4",
        "epoch": "2022-02-19T22:37:44.129568Z",
        "age_days": pytest.approx(199 * 30 / 86400, abs=1e-6),
        "samples": 200,
    }


def test_attitude_brings_the_field_into_the_base_frame(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    q = _quaternions(200)
    q[7] = np.nan
    filled, _ = with_reference(replace(samples, q_base_gcrf=q), orbits[:1], FIELD)
    assert filled.r_itrf_km is not None
    b_gcrf_nt: Floats = itrf_to_gcrf(samples.t_utc, FIELD.field_itrf_nt(samples.t_utc, filled.r_itrf_km))
    np.testing.assert_allclose(_given(filled.b_ref_gcrf_nt), b_gcrf_nt, rtol=0, atol=1e-8)
    known = np.arange(200) != 7
    assert filled.b_ref_base_nt is not None
    np.testing.assert_allclose(filled.b_ref_base_nt[known], _turn(q[known], b_gcrf_nt[known]), rtol=0, atol=1e-8)
    assert np.isnan(filled.b_ref_base_nt[7]).all()
    assert not filled.flags.any()


def test_a_clock_that_is_behind_puts_the_satellite_on(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    filled, _ = with_reference(samples, orbits[:1], FIELD, time_offset_s=31.6)
    later = samples.t_utc + np.timedelta64(31_600_000_000, "ns")
    np.testing.assert_array_equal(filled.r_itrf_km, orbits[0].position_itrf_km(later))
    np.testing.assert_array_equal(filled.t_utc, samples.t_utc)


def test_a_session_between_two_tles_switches_at_the_middle(orbits: list[Sgp4Orbit]) -> None:
    middle = orbits[0].epoch_utc + (orbits[1].epoch_utc - orbits[0].epoch_utc) // 2
    t_utc = middle + (np.array([-60, -30, 30, 60]) * 10**9).astype("timedelta64[ns]")
    samples = Samples(t_utc=t_utc, h_nt=np.ones((4, 3)))
    filled, report = with_reference(samples, orbits, FIELD, max_orbit_age_days=60)
    assert [entry["samples"] for entry in report.orbits] == [2, 2]
    assert [entry["index"] for entry in report.orbits] == [0, 1]
    np.testing.assert_array_equal(_given(filled.r_itrf_km)[2:], orbits[1].position_itrf_km(t_utc[2:]))
    assert len(report.warnings) == 1
    assert report.warnings[0].startswith("tle_old: ")
    assert "23.5 d" in report.warnings[0]
    with pytest.raises(TleEpochError, match="limit 14"):
        with_reference(samples, orbits, FIELD)


def test_positions_in_the_telemetry_replace_the_orbit(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    r_km = orbits[0].position_itrf_km(samples.t_utc)
    r_km[5] = np.nan
    filled, report = with_reference(replace(samples, r_itrf_km=r_km), [], FIELD)
    assert report.orbit_model == "telemetry-position"
    assert filled.b_ref_magnitude_nt is not None
    assert np.isnan(filled.b_ref_magnitude_nt[5])
    np.testing.assert_array_equal(filled.flags.nonzero()[0], [5])
    assert filled.flags[5] == SampleFlag.NO_REFERENCE


def test_orbits_fill_the_gaps_of_positions_in_the_telemetry(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    """GNSS outages, or a session without GNSS beside one with it: a fix 10 km off shows which rows it gave."""
    by_orbit = orbits[0].position_itrf_km(samples.t_utc)
    r_km = by_orbit + 10.0
    r_km[50:80] = np.nan
    flagged = replace(samples, r_itrf_km=r_km).flagged(SampleFlag.NO_REFERENCE, np.isnan(r_km[:, 0]))
    filled, report = with_reference(flagged, orbits, FIELD)
    assert report.orbit_model == "sgp4+telemetry-position"
    assert [entry["samples"] for entry in report.orbits] == [30]
    np.testing.assert_allclose(_given(filled.r_itrf_km)[50:80], by_orbit[50:80], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(_given(filled.r_itrf_km)[:50], r_km[:50])
    assert filled.is_used.all()


def test_a_reference_in_the_telemetry_needs_neither_orbit_nor_model(samples: Samples) -> None:
    b_nt = np.random.default_rng(1).normal(scale=2e4, size=(200, 3))
    b_nt[3] = np.nan
    q = _quaternions(200)
    by_gcrf, report = with_reference(replace(samples, b_ref_gcrf_nt=b_nt, q_base_gcrf=q), [], FIELD)
    assert report.orbit_model == "telemetry-reference"
    np.testing.assert_allclose(_given(by_gcrf.b_ref_magnitude_nt), np.linalg.norm(b_nt, axis=1), rtol=1e-14)
    np.testing.assert_allclose(_given(by_gcrf.b_ref_base_nt), _turn(q, b_nt), rtol=0, atol=1e-9)
    assert by_gcrf.flags[3] == SampleFlag.NO_REFERENCE
    by_base, _ = with_reference(replace(samples, b_ref_base_nt=b_nt), [], FIELD)
    np.testing.assert_allclose(_given(by_base.b_ref_magnitude_nt), np.linalg.norm(b_nt, axis=1), rtol=1e-14)
    magnitude_nt = np.full(200, 3e4)
    by_size, _ = with_reference(replace(samples, b_ref_magnitude_nt=magnitude_nt), [], FIELD)
    np.testing.assert_array_equal(by_size.b_ref_magnitude_nt, magnitude_nt)
    assert by_size.b_ref_base_nt is None


def test_without_any_source_of_position_the_orbit_is_missing(samples: Samples) -> None:
    with pytest.raises(OrbitMissingError):
        with_reference(samples, [], FIELD)


def test_a_time_past_the_model_is_an_error(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    with pytest.raises(ModelRangeError):
        r_km = orbits[0].position_itrf_km(samples.t_utc)
        late = replace(samples, t_utc=samples.t_utc + np.timedelta64(3000, "D"), r_itrf_km=r_km)
        with_reference(late, [], FIELD)


def test_any_model_serves_and_nothing_given_is_changed(samples: Samples, orbits: list[Sgp4Orbit]) -> None:
    before = samples.h_nt.copy(), samples.flags.copy()
    filled, report = with_reference(samples, orbits[:1], DirectDipole())
    assert report.field_model == "dipole"
    np.testing.assert_array_equal(filled.h_nt, before[0])
    np.testing.assert_array_equal(samples.flags, before[1])
    assert samples.b_ref_magnitude_nt is None


@pytest.mark.real_data
def test_bro4s_on_board_field_is_the_tles_31_s_ahead(bro4_dir: Path) -> None:
    """The satellite was 31 s ahead of its TLE, 33 days from its epoch: as if the clock were 31 s behind."""
    table = np.genfromtxt(bro4_dir / "external.csv", delimiter=",", names=True)
    t_utc = table["ts"].astype(np.int64).view("datetime64[s]").astype("datetime64[ns]")
    on_board_nt = np.sqrt(sum(table[f"ephem_mageci_{i}"] ** 2 for i in range(3)))
    orbit = Sgp4Orbit.from_tle((bro4_dir / "tle.txt").read_text())
    samples = Samples(t_utc=t_utc, h_nt=np.ones((len(t_utc), 3)))
    rms_nt = {}
    for offset_s in (0.0, 31.0):
        filled, report = with_reference(samples, [orbit], FIELD, time_offset_s=offset_s, max_orbit_age_days=60)
        assert report.warnings[0].startswith("tle_old")
        difference_nt = filled.b_ref_magnitude_nt - on_board_nt
        rms_nt[offset_s] = float(np.sqrt(np.nanmean(difference_nt**2)))
    assert rms_nt[31.0] < 0.3 * rms_nt[0.0]

"""Wrong inputs are made from right ones by the very mistake that a user makes; right ones must stay unsuspected."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, quaternion_from_matrix, rotate
from magcal_core.calibration.diagnosis.wrong_input.suspicions import ClockFinding, suspicions
from magcal_core.field.igrf import Igrf
from magcal_core.orbit.earth.frames import convert_position, rotation_matrix
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.columns import with_reference
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, Simulation, simulate

START = np.datetime64("2022-02-19T22:37:44")
DEKART = SensorModel(
    np.array([2928.125, -1191.25, -1875.625]),
    np.array([1.032695, 1.006685, 1.032875]),
    np.array([-4.53, -1.067, 7.915]),
)
SKEWED = SensorModel(np.array([9000.0, -20000.0, 4000.0]), np.array([0.6, 1.7, 1.1]), np.array([25.0, -18.0, 30.0]))


@pytest.fixture(scope="module")
def orbit(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))


@pytest.fixture(scope="module")
def mission(orbit: Sgp4Orbit) -> Simulation:
    """Return 700 samples with 5 % of spikes of 20 uT: a suspicion must not hang on clean data."""
    disturbed = Disturbances(noise_nt=100.0, outlier_fraction=0.05, outlier_nt=20000.0)
    return simulate(orbit, DEKART, START, 7000.0, 10.0, disturbances=disturbed, seed=4)


def referenced(samples: Samples, orbit: Sgp4Orbit) -> Samples:
    return with_reference(samples, [orbit], Igrf())[0]


def only(samples: Samples) -> str:
    (found,) = suspicions(samples)
    assert found.ratio >= 5.0
    assert found.to_dict()["code"] == found.code
    return f"{found.code}: {found.candidate}"


def test_right_input_is_not_suspected(mission: Simulation, orbit: Sgp4Orbit) -> None:
    right = referenced(mission.samples, orbit)
    assert suspicions(right, position_field=Igrf()) == ()
    assert suspicions(replace(right, b_ref_base_nt=None, q_base_gcrf=None)) == ()


@pytest.mark.parametrize("sensor", [DEKART, SKEWED], ids=["square", "skewed"])
def test_every_signed_permutation_of_the_sensor_is_named(sensor: SensorModel, orbit: Sgp4Orbit) -> None:
    """All 47 wrong readings; what is named must be the inverse of what was done, so that applying it mends the data."""
    right = simulate(orbit, sensor, START, 6000.0, 20.0, disturbances=Disturbances(noise_nt=60.0), seed=7)
    right_samples = right.samples_with_reference
    names = "xyz"
    assert suspicions(right_samples) == ()
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        if order == (0, 1, 2) and signs == (1, 1, 1):
            continue
        wrong = replace(right_samples, h_nt=right_samples.h_nt[:, list(order)] * signs)
        back = [order.index(axis) for axis in range(3)]
        named = ", ".join(("-" if signs[j] < 0 else "") + names[j] for j in back)
        assert only(wrong) == f"frame_suspect: the sensor's axes ({named})"
        text = suspicions(wrong)[0].text
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        assert ("left-handed" in text) == (np.linalg.det(matrix) < 0)


def test_ned_and_enu_exchanged_in_the_reference_is_named(mission: Simulation) -> None:
    right = mission.samples_with_reference
    assert right.b_ref_base_nt is not None
    wrong = replace(right, b_ref_base_nt=right.b_ref_base_nt[:, [1, 0, 2]] * [1, 1, -1], q_base_gcrf=None)
    (found,) = suspicions(wrong)
    assert found.code == "frame_suspect"
    assert "NED and ENU" in found.text
    assert found.ratio >= 5.0


@pytest.mark.parametrize(
    ("mistake", "named"),
    [
        (lambda q: q * [1, -1, -1, -1], "inverse quaternions"),
        (lambda q: np.roll(q, -1, axis=1), "scalar-last quaternions"),
        (lambda q: np.roll(q * [1, -1, -1, -1], -1, axis=1), "inverse scalar-last quaternions"),
    ],
)
def test_wrong_quaternion_conventions_are_named(mission: Simulation, orbit: Sgp4Orbit, mistake, named) -> None:
    wrong = replace(mission.samples, q_base_gcrf=mistake(mission.samples.q_base_gcrf))
    assert only(referenced(wrong, orbit)) == f"frame_suspect: {named}"


def test_wrong_quaternions_and_wrong_axes_are_both_named(mission: Simulation, orbit: Sgp4Orbit) -> None:
    q, h = mission.samples.q_base_gcrf, mission.samples.h_nt
    assert q is not None
    wrong = replace(mission.samples, q_base_gcrf=q * [1, -1, -1, -1], h_nt=h[:, [1, 0, 2]])
    found = [one.candidate for one in suspicions(referenced(wrong, orbit))]
    assert found == ["inverse quaternions", "the sensor's axes (y, x, z)"]


def test_attitude_or_reference_in_teme_is_named(mission: Simulation, orbit: Sgp4Orbit) -> None:
    q = mission.samples.q_base_gcrf
    assert q is not None
    to_gcrf = rotation_matrix(mission.samples.t_utc[:1], "TEME", "GCRF")[0]
    of_teme = replace(mission.samples, q_base_gcrf=quaternion_from_matrix(attitude_matrix(q) @ to_gcrf))
    (found,) = suspicions(referenced(of_teme, orbit))
    assert (found.code, found.candidate) == ("frame_suspect", "attitude from TEME")
    right = referenced(mission.samples, orbit)
    assert right.b_ref_gcrf_nt is not None
    in_teme = right.b_ref_gcrf_nt @ to_gcrf
    (found,) = suspicions(replace(right, b_ref_gcrf_nt=in_teme, b_ref_base_nt=rotate(q, in_teme)))
    assert (found.code, found.candidate) == ("frame_suspect", "reference in TEME")


def test_inertial_positions_taken_for_itrf_are_named(mission: Simulation) -> None:
    inertial = convert_position(mission.t_true_utc, mission.r_itrf_km, "ITRF", "GCRF")
    filled, _ = with_reference(replace(mission.samples, r_itrf_km=inertial, q_base_gcrf=None), [], Igrf())
    (found,) = suspicions(filled, position_field=Igrf())
    assert found.code == "frame_suspect"
    assert found.candidate.startswith("positions in ")


@pytest.mark.parametrize(
    ("factor", "pair"), [(10.0, "mG taken for uT"), (0.1, "uT taken for mG"), (1e3, "nT taken for uT")]
)
def test_units_off_by_a_known_factor_are_named(mission: Simulation, factor: float, pair: str) -> None:
    right = mission.samples_with_reference
    (found,) = suspicions(replace(right, h_nt=right.h_nt * factor))
    assert found.code == "units_mismatch"
    assert pair in found.text
    assert found.ratio >= 5.0


def test_a_large_bias_is_no_wrong_unit(orbit: Sgp4Orbit) -> None:
    """60 uT of bias on every axis: |h| is three times |B|, and still no unit is suspected."""
    biased = SensorModel(np.array([60000.0, -60000.0, 60000.0]), np.array([1.3, 0.7, 1.1]), np.zeros(3))
    assert suspicions(simulate(orbit, biased, START, 6000.0, 10.0, seed=2).samples_with_reference) == ()


@pytest.mark.parametrize(("shift_s", "named"), [(18, "GPS time"), (37, "TAI time")])
def test_another_time_scale_is_named_with_and_without_attitude(
    mission: Simulation, orbit: Sgp4Orbit, shift_s: int, named: str
) -> None:
    """GPS was 18 s, TAI 37 s ahead of UTC in 2022 (IERS Bulletin C)."""
    wrong = replace(mission.samples, t_utc=mission.samples.t_utc + np.timedelta64(shift_s, "s"), q_base_gcrf=None)
    (found,) = suspicions(referenced(wrong, orbit))
    assert (found.code, found.candidate) == ("time_scale_suspect", named)


@pytest.mark.parametrize("shift_s", [-18, 9, 14, 23, 31])
def test_another_clock_offset_is_no_time_scale(mission: Simulation, orbit: Sgp4Orbit, shift_s: int) -> None:
    """31 s is what an old TLE looked like on real data: an offset, but no scale's."""
    wrong = replace(mission.samples, t_utc=mission.samples.t_utc + np.timedelta64(shift_s, "s"), q_base_gcrf=None)
    assert suspicions(referenced(wrong, orbit)) == ()


def test_an_estimated_offset_is_compared_with_the_scales(mission: Simulation) -> None:
    samples = mission.samples_with_reference
    (found,) = suspicions(samples, clock=ClockFinding(18.05, 0.03))
    assert found.candidate == "GPS time"
    assert suspicions(samples, clock=ClockFinding(19.2, 0.5)) == ()


def test_too_few_samples_are_not_judged(mission: Simulation) -> None:
    assert suspicions(mission.samples_with_reference.take(slice(0, 25))) == ()

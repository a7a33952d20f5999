"""What errors of the reference do to the parameters: against fits to a reference that has them."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core import calibrate
from magcal_core.field.igrf import Igrf
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

START = np.datetime64("2022-03-01T00:00:00", "ns")


class Outside:
    """IGRF with a uniform field along the Earth's axis."""

    name = "outside"

    def field_itrf_nt(self, t_utc, r_itrf_km):
        return Igrf().field_itrf_nt(t_utc, r_itrf_km) + np.array([0.0, 0.0, 40.0])


@pytest.fixture(scope="module")
def orbit():
    return draw_orbit(np.random.default_rng(5), START)


def flown(orbit, field=None):
    sensor = SensorModel([2928.0, -1191.0, -1875.0], [1.03, 1.007, 1.033], [-4.5, -1.1, 7.9])
    return simulate(orbit, sensor, START, 11400.0, 10.0, field_model=field, disturbances=Disturbances(20.0), seed=2)


@pytest.mark.parametrize("method", ["scalar", "vector"])
def test_an_external_field_moves_the_parameters_as_foretold(orbit, method):
    """The same noise with and without 40 nT: first order from 256 of 1140 samples, to 10 % of each group's largest."""
    with_it = calibrate(flown(orbit, Outside()).samples, [orbit], method=method)
    without = calibrate(flown(orbit).samples, [orbit], method=method)
    (found,) = [one for one in with_it.extras["uncertainty"]["reference"] if one["source"] == "external"]
    for group in ("bias_nt", "scale", "nonorthogonality_deg"):
        moved = np.abs(getattr(with_it.parameters, group) - getattr(without.parameters, group))
        foretold = np.array(found["standard_errors"][group])
        np.testing.assert_allclose(foretold, moved, atol=0.1 * moved.max())


def test_the_standard_errors_contain_the_shifts(orbit):
    got = calibrate(flown(orbit).samples, [orbit])
    for one in got.extras["uncertainty"]["reference"]:
        for group in ("bias_nt", "scale", "nonorthogonality_deg"):
            assert np.all(getattr(got.standard_errors, group) >= np.array(one["standard_errors"][group]))


def test_a_late_orbit_is_considered_only_where_no_clock_was_estimated(orbit):
    samples = flown(orbit).samples
    plain, clocked = calibrate(samples, [orbit]), calibrate(samples, [orbit], time_offset="estimate")
    sources = [{one["source"] for one in got.extras["uncertainty"]["reference"]} for got in (plain, clocked)]
    assert sources == [{"external", "orbit_along_track"}, {"external"}]


def test_a_reference_from_the_telemetry_has_errors_that_are_not_known(orbit):
    made = flown(orbit)
    got = calibrate(replace(made.samples_with_reference, q_base_gcrf=None))
    assert got.extras["uncertainty"]["reference"] == []

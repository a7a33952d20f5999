"""Devices that were switched in simulation: their offset must come out of the jumps, with errors that hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magcal_core.calibration.diagnosis.device_steps import device_step, device_steps, switching_columns
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.calibration.estimators.vector import VectorFit
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.observations import Observations
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, simulate

SENSOR = SensorModel(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))
OFFSET = np.array([420.0, -150.0, 260.0])


@pytest.fixture(scope="module")
def orbit(data_dir: Path) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))


def switched(orbit, seed: int, *, period_s: float = 600.0, level: float = 1.0, **more) -> Samples:
    """Return 700 samples of a sensor with a device that is on every other ``period_s``, and a drifting bias."""
    disturbed = Disturbances(noise_nt=60.0, wave_nt=(250.0, 0.0, 0.0), wave_period_s=2400.0, **more)
    made = simulate(
        orbit, SENSOR, np.datetime64("2022-02-19T22:37:44"), 7000.0, 10.0, disturbances=disturbed, seed=seed
    )
    samples = made.samples_with_reference
    t_s = 10.0 * np.arange(700)
    state = level * ((t_s / period_s).astype(int) % 2)
    return replace(samples, h_nt=samples.h_nt + np.outer(state, OFFSET) / level, housekeeping={"payload": state})


@pytest.mark.parametrize("is_vector", [False, True])
def test_the_offset_is_found_whether_or_not_the_calibration_knew_of_it(orbit, is_vector: bool) -> None:
    """Each component within 4.5 honest errors; under a 250 nT wave, with which no regression over the session copes."""
    samples = switched(orbit, 1)
    estimator = VectorFit() if is_vector else ScalarFit()
    for named in ((), ("payload",)):
        fit = estimator.fit(Observations.of(samples, named), FitSettings())
        found = device_step(Observations.of(samples, ["payload"]), fit.parameters, "payload", is_vector=is_vector)
        assert np.all(np.abs(found.offset_nt - OFFSET) < 4.5 * found.standard_errors_nt)
        assert found.standard_errors_nt.max() < (20.0 if is_vector else 90.0)
        assert found.is_significant
        assert found.transitions == 11
        assert "payload adds" in found.text


@pytest.mark.parametrize("is_vector", [False, True])
def test_its_errors_cover_the_truth_at_the_rate_they_claim(orbit, is_vector: bool) -> None:
    """30 seeds, three components: 95 % intervals must cover between 86 and 100 % of 90 values (4 sigma of binomial)."""
    inside = []
    for seed in range(30):
        samples = switched(orbit, 100 + seed)
        fit = (VectorFit() if is_vector else ScalarFit()).fit(Observations.of(samples, ["payload"]), FitSettings())
        found = device_step(Observations.of(samples, ["payload"]), fit.parameters, "payload", is_vector=is_vector)
        inside += list(np.abs(found.offset_nt - OFFSET) < 1.96 * found.standard_errors_nt)
    assert 0.86 <= np.mean(inside) <= 1.0


def test_spikes_move_the_offset_by_less_than_an_error(orbit) -> None:
    found = []
    for fraction in (0.0, 0.05):
        samples = switched(orbit, 5, outlier_fraction=fraction, outlier_nt=20000.0)
        fit = VectorFit().fit(Observations.of(samples, ["payload"]), FitSettings(robust="huber"))
        found.append(device_step(Observations.of(samples, ["payload"]), fit.parameters, "payload", is_vector=True))
    assert np.all(np.abs(found[1].offset_nt - found[0].offset_nt) < 1.5 * found[1].standard_errors_nt)


def test_levels_give_the_offset_per_unit(orbit) -> None:
    samples = switched(orbit, 1, level=40.0)
    fit = VectorFit().fit(Observations.of(samples, ["payload"]), FitSettings())
    found = device_step(Observations.of(samples, ["payload"]), fit.parameters, "payload", is_vector=True)
    assert np.all(np.abs(found.offset_nt - OFFSET / 40.0) < 4.5 * found.standard_errors_nt)


def test_a_device_without_effect_is_not_significant(orbit) -> None:
    """Ten seeds at a level of 1 %: one false alarm at most."""
    alarms = 0
    for seed in range(10):
        samples = switched(orbit, 200 + seed)
        idle = replace(samples, h_nt=samples.h_nt - np.outer(samples.housekeeping["payload"], OFFSET))
        fit = VectorFit().fit(Observations.of(idle), FitSettings())
        step = device_step(Observations.of(idle, ["payload"]), fit.parameters, "payload", is_vector=True)
        alarms += step.is_significant
    assert alarms <= 1


def test_too_few_jumps_are_refused_and_told(orbit) -> None:
    samples = switched(orbit, 1, period_s=6000.0)
    observations = Observations.of(samples, ["payload"])
    fit = ScalarFit().fit(observations, FitSettings())
    with pytest.raises(NotObservableError, match="jumps"):
        device_step(observations, fit.parameters, "payload", is_vector=False)
    found, warnings = device_steps(observations, fit.parameters, ["payload"], is_vector=False)
    assert found == ()
    assert warnings[0].startswith("device_not_observable: payload")
    with pytest.raises(OptionError):
        device_step(observations, fit.parameters, "heater", is_vector=False)


def test_devices_are_told_from_other_housekeeping() -> None:
    n = 400
    columns = {
        "payload": (np.arange(n) // 50 % 2).astype(float),
        "once": (np.arange(n) > 200).astype(float),
        "temperature": np.sin(np.arange(n) / 30.0),
        "constant": np.ones(n),
        "flutter": (np.arange(n) % 2).astype(float),
    }
    assert switching_columns(columns) == ("payload",)

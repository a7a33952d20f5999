"""Independent estimators of the same covariance beside ours: Newey and West's, and Andrews' quadratic-spectral."""

import json
from itertools import combinations

import numpy as np
import pytest

from magcal_core import calibrate
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.linear_rows import rows_of
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.field.models import field_model
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.telemetry import read_samples
from tests.magcal_core.calibration.quadratic_spectral import long_run_covariance

PLAIN = {"robust": "none", "noise_model": "none", "time_offset": "none", "locked_terms": "none"}


def newey_west(observations, fit):
    """Standard errors from the scores of every sample, Bartlett's kernel over 4 (n / 100)^(2/9) lags."""
    (channel,) = rows_of(observations, fit).channels
    scores = channel.jacobian * channel.y[:, None]
    inverse = np.linalg.inv(channel.jacobian.T @ channel.jacobian)
    lags = int(4.0 * (len(scores) / 100.0) ** (2.0 / 9.0))
    middle = scores.T @ scores
    for lag in range(1, lags + 1):
        across = scores[lag:].T @ scores[:-lag]
        middle += (1.0 - lag / (lags + 1.0)) * (across + across.T)
    own = rows_of(observations, fit).unknowns.to_parameters(rows_of(observations, fit).matrix)
    return np.sqrt(np.diag(own @ inverse @ middle @ inverse @ own.T))


def quadratic_spectral(observations, fit):
    """Standard errors from the scores of every sample under Andrews' kernel and bandwidth."""
    (channel,) = rows_of(observations, fit).channels
    scores = channel.jacobian * channel.y[:, None]
    inverse = np.linalg.inv(channel.jacobian.T @ channel.jacobian)
    own = rows_of(observations, fit).unknowns.to_parameters(rows_of(observations, fit).matrix)
    return np.sqrt(np.diag(own @ inverse @ long_run_covariance(scores) @ inverse @ own.T))


def test_under_white_noise_both_say_the_same(mission):
    """Ours have Student's t and what so short a session may hide: 0.95 to 1.6 times the other ones in the mean."""
    samples = mission(n=1150, noise_nt=60.0).samples
    observations = Observations.of(samples)
    fit = ESTIMATORS["scalar"].fit(observations, FitSettings())
    ours = calibrate(samples).standard_errors.vector[:9]
    for theirs in (newey_west(observations, fit), quadratic_spectral(observations, fit)):
        assert 0.95 < np.exp(np.mean(np.log(ours / theirs))) < 1.6


def test_under_heat_of_the_orbit_only_ours_holds_the_truth(data_dir):
    """The plain estimate is some of Newey and West's errors off; the estimate beside locked errors is within ours."""
    folder = data_dir / "trust"
    answer = json.loads((folder / "expected.json").read_text())["heat_nadir_scalar"]
    samples = read_samples(folder / "heat_nadir_scalar.csv")
    orbit = Sgp4Orbit.from_tle((folder / "heat_nadir_scalar.tle").read_text())
    planted = answer["truth"]
    truth = np.concatenate([planted["bias_nt"], planted["scale"], planted["nonorthogonality_deg"]])
    referenced = Referenced.of(samples, [orbit], CalibrationOptions())
    observations = referenced.observations(referenced.usable((), is_vector=False), ())
    fit = ESTIMATORS["scalar"].fit(observations, FitSettings())
    theirs = np.abs(fit.parameters.vector - truth) / newey_west(observations, fit)
    found = calibrate(samples, [orbit])
    ours = np.abs(found.parameters.vector[:9] - truth) / found.standard_errors.vector[:9]
    assert theirs.max() > 4.0
    assert ours.max() < 2.5


@pytest.mark.parametrize("rho", [-0.3, 0.0, 0.5, 0.8])
def test_the_quadratic_spectral_estimator_finds_the_variance_of_a_sum(rho):
    """Of a first-order process that is n s^2 / (1 - rho)^2 in closed form; mean of 40 series of 2000 to 12 %."""
    random = np.random.default_rng(8100)
    noise = random.normal(size=(2000, 40))
    series = np.zeros_like(noise)
    for i in range(1, len(noise)):
        series[i] = rho * series[i - 1] + noise[i]
    found = [float(long_run_covariance(series[:, [k]] - series[:, k].mean())[0, 0]) for k in range(40)]
    assert np.mean(found) / (2000.0 / (1.0 - rho) ** 2) == pytest.approx(1.0, abs=0.12)


def covered(orbit, seed, heat_nt):
    """Return which of nine intervals hold the truth: ours, and those of the quadratic-spectral estimator.

    A day of a satellite whose axes keep to the orbit (z down, y against the normal), every two minutes; its bias
    swings with the orbit by ``heat_nt`` on every axis, each with a phase of its own.
    """
    random = np.random.default_rng(seed)
    t_utc = orbit.epoch_utc.astype("datetime64[ns]") + np.arange(720) * np.timedelta64(120, "s")
    r_km, v_km_s = orbit.state_gcrf(t_utc)
    down, across = -r_km, -np.cross(r_km, v_km_s)
    axes = [np.cross(across, down), across, down]
    frame = np.stack([axis / np.linalg.norm(axis, axis=1)[:, None] for axis in axes], axis=1)
    b_itrf_nt = field_model("igrf").field_itrf_nt(t_utc, orbit.position_itrf_km(t_utc))
    b_nt = np.einsum("nij,nj->ni", frame, itrf_to_gcrf_fast(t_utc, b_itrf_nt))
    sensor = SensorModel(random.uniform(-5e3, 5e3, 3), random.uniform(0.9, 1.1, 3), random.uniform(-5.0, 5.0, 3))
    turn = 2.0 * np.pi * np.arange(720) * 120.0 / (2.0 * np.pi / orbit.elements.satrec().no_kozai * 60.0)
    heat = heat_nt * np.cos(turn[:, None] + random.uniform(0.0, 2.0 * np.pi, 3))
    h_nt = sensor.apply(b_nt) + heat + 50.0 * random.normal(size=(720, 3))
    truth = np.concatenate([sensor.bias_nt + heat.mean(axis=0), sensor.scale, sensor.nonorthogonality_deg])
    samples = Samples(t_utc, h_nt, b_ref_magnitude_nt=np.linalg.norm(b_nt, axis=1))
    observations = Observations.of(samples)
    found = calibrate(samples, [orbit])
    fit = ESTIMATORS["scalar"].fit(observations, FitSettings(is_gated=False))
    ours = np.abs(found.parameters.vector[:9] - truth) <= 1.96 * found.standard_errors.vector[:9]
    return ours, np.abs(fit.parameters.vector - truth) <= 1.96 * quadratic_spectral(observations, fit)


def test_what_ours_and_the_quadratic_spectral_estimator_cover(data_dir):
    """Without slow errors both hold; under errors locked to the orbit ours hold and the other ones do not.

    Of 40 sessions each: 98 and 96 % clean, 92 and 50 % under a swing of 150 nT of the bias.
    """
    orbit = Sgp4Orbit.from_tle((data_dir / "trust" / "heat_nadir_scalar.tle").read_text())
    clean = np.mean([covered(orbit, seed, 0.0) for seed in range(8100, 8116)], axis=(0, 2))
    locked = np.mean([covered(orbit, seed, 150.0) for seed in range(8200, 8216)], axis=(0, 2))
    assert clean.min() >= 0.9
    assert locked[0] >= 0.85
    assert locked[1] <= 0.7


@pytest.mark.real_data
def test_quarters_of_bro4_agree_within_their_intervals(bro4_dir):
    """Four quarters against the field computed on board: 54 differences, 85 % within their 95 % intervals.

    And no group scatters more than 1.5 times as much as under Tukey's loss without locked terms.
    """
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    reference = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    samples = read_samples(bro4_dir / "external.csv", columns=columns | reference, unit="mG")
    orbit = Sgp4Orbit.from_tle((bro4_dir / "tle.txt").read_text())
    quarters = [samples.take(part) for part in np.array_split(np.arange(len(samples)), 4)]
    ours = [calibrate(one, [orbit], max_orbit_age_days=60.0) for one in quarters]
    plain = [calibrate(one, [orbit], max_orbit_age_days=60.0, **(PLAIN | {"robust": "tukey"})) for one in quarters]
    inside = []
    for one, other in combinations(ours, 2):
        size = np.hypot(one.standard_errors.vector[:9], other.standard_errors.vector[:9])
        inside.append(np.abs(one.parameters.vector[:9] - other.parameters.vector[:9]) < 1.96 * size)
    assert np.mean(inside) >= 0.85
    scatter = [np.std([one.parameters.vector[:9] for one in made], axis=0, ddof=1) for made in (ours, plain)]
    for group in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert np.linalg.norm(scatter[0][group]) <= 1.5 * np.linalg.norm(scatter[1][group])


@pytest.mark.real_data
def test_quarters_of_bro4_by_a_tle_of_33_days(bro4_dir):
    """The same against a TLE of 33 days, whose clock each quarter finds: 52 of 54 differences lie within 95 %.

    The telemetry is of shadow, every 10 s, and sparsely of the sun, where the bias is another one: while half of the
    sunlit rows stayed in the fit, and heat was followed from sample to sample alone, they were 43. No group scatters
    more than under Tukey's loss without a clock or locked terms.
    """
    columns = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
    samples = read_samples(bro4_dir / "external.csv", columns=columns, unit="mG")
    orbit = Sgp4Orbit.from_tle((bro4_dir / "tle.txt").read_text())
    quarters = [samples.take(part) for part in np.array_split(np.arange(len(samples)), 4)]
    ours = [calibrate(one, [orbit], max_orbit_age_days=60.0) for one in quarters]
    plain = [calibrate(one, [orbit], max_orbit_age_days=60.0, **(PLAIN | {"robust": "tukey"})) for one in quarters]
    assert all(one.extras["time_offset"]["is_taken"] for one in ours)
    inside = []
    for one, other in combinations(ours, 2):
        size = np.hypot(one.standard_errors.vector[:9], other.standard_errors.vector[:9])
        inside.append(np.abs(one.parameters.vector[:9] - other.parameters.vector[:9]) < 1.96 * size)
    assert np.mean(inside) >= 0.85
    assert all(any(warning.startswith("odd_light") for warning in one.warnings) for one in ours)
    scatter = [np.std([one.parameters.vector[:9] for one in made], axis=0, ddof=1) for made in (ours, plain)]
    for group in (slice(0, 3), slice(3, 6), slice(6, 9)):
        assert np.linalg.norm(scatter[0][group]) <= np.linalg.norm(scatter[1][group])

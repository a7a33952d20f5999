"""Wherever the search for the scalar fit is told to start, it ends at the one optimum."""

from pathlib import Path

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations
from magcal_core.reference.columns import with_reference
from magcal_core.sensor.parameters import Parameters

COLUMNS = {
    "time": "ts",
    **{f"b{axis}": f"extmag_{i}" for i, axis in enumerate("xyz")},
    **{f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")},
}


@pytest.mark.real_data
def test_a_hundred_random_starts_end_at_the_optimum_of_real_telemetry(bro4_dir: Path) -> None:
    """Offsets within 60 uT, scale factors 0.3 to 3, angles within 50 deg; 0.01 nT is 1e-4 of the errors."""
    samples = mc.read_samples(bro4_dir / "external.csv", columns=COLUMNS, unit="mG")
    observations = Observations.of(with_reference(samples, [], mc.Igrf())[0])
    plain = ESTIMATORS["scalar"].fit(observations, FitSettings())
    rng = np.random.default_rng(20260101)
    for _ in range(100):
        start = Parameters(rng.uniform(-60e3, 60e3, 3), rng.uniform(0.3, 3.0, 3), rng.uniform(-50.0, 50.0, 3))
        fit = ESTIMATORS["scalar"].fit(observations, FitSettings(start=start))
        np.testing.assert_allclose(fit.parameters.bias_nt, plain.parameters.bias_nt, rtol=0, atol=0.01)
    assert np.sqrt(np.mean(plain.residuals_nt**2)) == pytest.approx(181.5, abs=1.0)

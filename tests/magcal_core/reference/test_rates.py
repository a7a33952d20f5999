"""The derivative of the reference by the clock: of the observations themselves, as if they had been made anew."""

import numpy as np
import pytest

from magcal_core.calibration.terms.locked_clock import RATE_STEP_S, with_derivative
from magcal_core.estimation.session import LockedSession
from magcal_core.options import CalibrationOptions
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.telemetry import read_samples


@pytest.mark.parametrize("name", ["clean_tumble", "heat_nadir"])
def test_rates_are_bit_for_bit_those_of_observations_made_anew(data_dir, name):
    """Of |B| alone and with attitude, at the telemetry's clock and 20 s off."""
    folder = data_dir / "trust"
    samples = read_samples(folder / f"{name}.csv", field_range_nt=None)
    orbit = Sgp4Orbit.from_tle((folder / f"{name}.tle").read_text())
    referenced = Referenced.of(samples, [orbit], CalibrationOptions())
    is_vector = samples.q_base_gcrf is not None
    usable = referenced.usable((), is_vector)
    session, plain = LockedSession(referenced, usable, is_vector), referenced.observations(usable, ())
    for offset_s in (0.0, 20.0):
        anew = [session.at_offset((), offset_s + step_s) for step_s in (RATE_STEP_S, -RATE_STEP_S)]
        made, expected = session.with_rates(plain, offset_s), with_derivative(plain, *anew)
        np.testing.assert_array_equal(made.rate_nt_s, expected.rate_nt_s)
        assert (made.rate_base_nt_s is None) == (expected.rate_base_nt_s is None)
        if made.rate_base_nt_s is not None:
            np.testing.assert_array_equal(made.rate_base_nt_s, expected.rate_base_nt_s)

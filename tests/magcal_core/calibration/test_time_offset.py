"""The clock's search ends with the reference where the clock says it is."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration import ESTIMATORS, FitSettings, Observations
from magcal_core.calibration.time_offset import fit_with_clock


@pytest.mark.parametrize("method", ["scalar", "vector"])
@pytest.mark.parametrize("has_drift", [False, True])
def test_the_last_step_moves_the_reference_as_an_evaluation_anew_would(mission, method, has_drift):
    """Moved along its expansion by less than 5e-3 s: 1e-12 nT of what is left out, and rounding of 5e4 nT."""
    samples = mission(n=900, noise_nt=40.0, seed=9).samples
    o = Observations.of(samples)
    size, turn = o.b_nt, o.require_vector() / o.b_nt[:, None]

    def at(shift_s):
        moved = size + 2000.0 * np.sin((o.t_s + shift_s) / 700.0)
        return replace(o, b_nt=moved, b_base_nt=turn * moved[:, None])

    truth = at(np.full(len(o), 3.0) + (1e-4 * (o.t_s - o.t_s.mean()) if has_drift else 0.0))
    noise_nt = o.h_nt - o.require_vector()
    sent = replace(o, h_nt=np.ascontiguousarray(truth.require_vector() + noise_nt))

    def sent_at(shift_s, rows=slice(None)):
        return replace(at(shift_s), h_nt=sent.h_nt).take(rows)

    found = fit_with_clock(ESTIMATORS[method], sent_at, sent_at(np.zeros(len(o))), FitSettings(), has_drift=has_drift)
    assert found.is_converged
    drift = (found.drift_s_per_day or 0.0) / 86400.0
    want = sent_at(found.offset_s + drift * (o.t_s - 0.5 * (o.t_s[0] + o.t_s[-1])))
    np.testing.assert_allclose(found.observations.b_nt, want.b_nt, atol=1e-8)
    np.testing.assert_allclose(found.observations.b_base_nt, want.b_base_nt, atol=1e-8)
    anew = ESTIMATORS[method].fit(replace(want, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None), FitSettings())
    np.testing.assert_allclose(found.fit.residuals_nt, anew.residuals_nt, atol=1e-3)
    np.testing.assert_allclose(found.fit.parameters.bias_nt, anew.parameters.bias_nt, atol=1e-3)

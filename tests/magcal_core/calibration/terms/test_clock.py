"""The clock's search ends with the reference where the clock says it is."""

from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.terms.clock import fit_with_clock
from magcal_core.observations import Observations


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


def test_a_search_that_begins_on_some_samples_ends_where_one_on_all_does(mission):
    """Against cold fits of all 45,000 samples at the exact reference, within a thousandth of each standard error.

    The robust scale of so many samples is iterated to 1e-4, and the estimate with it.
    """
    samples = mission(n=45_000, noise_nt=40.0, seed=4).samples
    o = Observations.of(samples)
    struck = np.where(np.arange(len(o)) % 50 == 7, 9000.0, 0.0)
    turn, noise_nt = o.require_vector() / o.b_nt[:, None], o.h_nt - o.require_vector()

    def size(t_s):
        return 40_000.0 + 9000.0 * np.sin(t_s / 600.0)

    h_nt = np.ascontiguousarray(turn * size(o.t_s + 3.0)[:, None] + noise_nt + struck[:, None])
    settings = FitSettings("huber")

    def at(shift_s, rows=slice(None)):
        few = replace(o, h_nt=h_nt).take(rows)
        return replace(few, b_nt=size(few.t_s + shift_s), b_base_nt=None)

    found = fit_with_clock(ESTIMATORS["scalar"], at, at(0.0), settings, has_drift=False)
    assert found.is_converged
    offset_s = 0.0
    for _ in range(8):
        rate = -9000.0 / 600.0 * np.cos((o.t_s + offset_s) / 600.0)
        slow = ESTIMATORS["scalar"].fit(replace(at(offset_s), rate_nt_s=rate[:, None]), settings)
        offset_s += float(slow.clock[0])
        if abs(slow.clock[0]) < 1e-5 * np.sqrt(slow.covariance[-1, -1]):
            break
    errors = np.sqrt(np.diag(slow.covariance))
    assert abs(found.offset_s - offset_s) < 1e-3 * errors[-1]
    moved = (found.fit.parameters.vector - slow.parameters.vector)[:9] / errors[:9]
    np.testing.assert_allclose(moved, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(found.fit.covariance)), errors, rtol=1e-3)

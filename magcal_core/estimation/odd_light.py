"""Step 7, its end: where the loss rejects rows in the sun alone, or in shadow alone, all of these are left out."""

from __future__ import annotations

from dataclasses import replace

from magcal_core.calibration.estimators.loss import AUTO, AUTO_LOSS
from magcal_core.calibration.terms.odd_light import odd_light
from magcal_core.estimation.clock import with_clock
from magcal_core.estimation.estimate import Estimate
from magcal_core.estimation.noise import with_noise
from magcal_core.estimation.start_and_loss import started


def without_odd_light(estimate: Estimate) -> Estimate:
    """Return the estimate, start, loss, clock and noise anew, without rows of a light that the loss rejects.

    Only where the data chose the loss and locked errors are weighed: published figures, and a loss that is asked for by
    name, stay what they are. What a regressor explains is not rejected: so this comes after them.

    Raises
    ------
    EstimationError
        The rows that are left make no estimate.
    """
    prepared, clock = estimate.prepared, estimate.clock
    options = prepared.options
    is_chosen = options.robust == AUTO and estimate.settings.robust == AUTO_LOSS and options.locked_terms == "auto"
    if not is_chosen or not prepared.estimator.takes_regressors:
        return estimate
    offset_s = 0.0 if clock is None else clock.offset_s
    light = prepared.session.light(offset_s)
    odd = None if light is None else odd_light(estimate.fit.weights, light)
    if odd is None:
        return estimate
    again = with_noise(with_clock(started(prepared.without(odd.rows)), near_s=offset_s))
    return replace(again, ablation=estimate.ablation, candidates=estimate.candidates, odd_light=odd)

"""Step 10, the gate: whether the rows that the loss has left determine the sensor, above their noise."""

from __future__ import annotations

from magcal_core.calibration.estimators.scalar_gate import require_observable_fit
from magcal_core.estimation.estimate import Estimate


def gated(estimate: Estimate) -> Estimate:
    """Return ``estimate`` where its samples determine the sensor.

    Raises
    ------
    NotObservableError
        They do not. The vector methods have tested their axes when they were fitted.
    """
    if not estimate.estimator.is_vector and not estimate.loss.is_clean:
        require_observable_fit(estimate.observations, estimate.fit)
    return estimate

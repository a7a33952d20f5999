"""Step 4, start and loss: the plain fit, and where it is not clean a start that half of the rows may be wrong for."""

from __future__ import annotations

from magcal_core.calibration.estimators.loss import fit_under_loss
from magcal_core.estimation.estimate import Estimate, Prepared


def started(prepared: Prepared) -> Estimate:
    """Return the first estimate, at the telemetry's own clock; nothing is gated yet.

    Raises
    ------
    EstimationError
        No estimate can be made at all.
    """
    found = fit_under_loss(prepared.estimator, prepared.observations, prepared.settings)
    return Estimate(prepared, prepared.observations, found.fit, found)

"""Step 7, regressors: the columns that were asked for by name, or those that the data bear out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Observations
from magcal_core.calibration.regressors import ablation_of, choose_regressors, usable_columns
from magcal_core.calibration.terms.regressor_evidence import SmoothBias
from magcal_core.estimation.clock import with_clock
from magcal_core.estimation.estimate import Estimate, Prepared, still
from magcal_core.estimation.start_and_loss import started


def with_regressors(estimate: Estimate) -> Estimate:
    """Return the estimate with the regressors that the options ask for or the data support, and what was tried.

    Raises
    ------
    EstimationError
        The samples do not determine the sensor beside the regressors.
    """
    prepared = estimate.prepared
    if prepared.names:
        at = still(estimate.observations)
        return replace(estimate, ablation=ablation_of(prepared.estimator, at, estimate.settings, [(), prepared.names]))
    if prepared.options.regressors != "auto" or not prepared.estimator.takes_regressors:
        return estimate
    offered, rows = _with_all_columns(prepared, still(estimate.observations))
    session = prepared.session
    locked = session.columns(estimate.observations, estimate.fit)
    smooth = SmoothBias(
        None if locked is None else replace(locked, columns=locked.columns[rows]), prepared.options.seed
    )
    settings = replace(estimate.settings, is_gated=False)
    choice = choose_regressors(prepared.estimator, offered, settings, smooth)
    if not choice.names:
        return replace(estimate, ablation=choice.ablation)
    anew = started(prepared.with_names(choice.names))
    if estimate.clock is not None:
        anew = with_clock(anew)
    elif estimate.tried_clock is not None or estimate.far_clock is not None:
        anew = replace(anew, coarse=estimate.coarse, far_clock=estimate.far_clock, tried_clock=estimate.tried_clock)
    return replace(anew, ablation=choice.ablation)


def _with_all_columns(prepared: Prepared, observations: Observations) -> tuple[Observations, NDArray[np.bool_]]:
    """Return the observations with every housekeeping column that may be a regressor, and which rows have them all."""
    keeping = prepared.referenced.samples.housekeeping
    names = usable_columns(keeping, prepared.usable)
    columns = {name: np.asarray(keeping[name], np.float64)[prepared.usable] for name in names}
    rows = np.ones(len(observations), np.bool_)
    for column in columns.values():
        rows &= np.isfinite(column)
    return replace(observations, regressors=columns).take(rows), rows

"""The residual of every sample, the left-out ones included where they have a reading and a reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask
from magcal_core.calibration.diagnosis.sample_flags import jumps, saturated, spikes
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.residuals import ResidualTable
from magcal_core.observations import Observations
from magcal_core.samples import SampleFlag, Samples
from magcal_core.sensor.correction import FittedReadings
from magcal_core.sensor.regressors import TIME_REGRESSOR, regressor_of, with_steps


def residual_table(samples: Samples, usable: Mask, observations: Observations, fit: Fit) -> ResidualTable:
    """Return the residuals of ``samples``, of which ``fit`` had the ``usable`` ones as ``observations``."""
    flags = _flagged(samples, usable, observations, fit)
    readings = FittedReadings(samples.h_nt, _columns(samples, usable, fit), fit.parameters)
    model_nt = _placed(observations.b_nt, usable, samples.b_ref_magnitude_nt)
    if fit.residuals_nt.ndim == 2 and samples.b_ref_base_nt is not None:
        residual = readings.corrected_base_nt
        residual -= _placed(observations.require_vector(), usable, samples.b_ref_base_nt)
    else:
        residual = readings.corrected_nt
        residual -= model_nt
    weight = _placed(fit.weights, usable, 0.0)
    return ResidualTable(samples.t_utc, model_nt, residual, weight, flags, readings, samples.r_itrf_km)


def _placed(values: Floats, usable: Mask, others: Floats | float | None) -> Floats:
    """Return ``values`` of the ``usable`` samples among the ``others``; the values themselves where all are usable."""
    if len(values) == len(usable):
        return values
    filled = np.empty((len(usable), *values.shape[1:]))
    filled[:] = np.nan if others is None else others
    filled[usable] = values
    return filled


def _flagged(samples: Samples, usable: Mask, observations: Observations, fit: Fit) -> NDArray[np.uint16]:
    """Return the samples' flags with the spikes, jumps and saturation that the fit shows."""
    is_whole = bool(usable.all())
    flagged = samples
    for flag, found in (
        (SampleFlag.SPIKE, spikes(fit.residuals_nt)),
        (SampleFlag.JUMP, jumps(fit.residuals_nt)),
        (SampleFlag.SATURATED, saturated(observations.h_nt)),
    ):
        where = found
        if not is_whole:
            where = np.zeros(len(samples), dtype=bool)
            where[usable] = found
        flagged = flagged.flagged(flag, where)
    return flagged.flags


def _columns(samples: Samples, usable: Mask, fit: Fit) -> dict[str, Floats]:
    """Return the regressors of every sample: NaN where one has none."""
    t_s = (samples.t_utc - samples.t_utc[usable][0]) / np.timedelta64(1, "ns") * 1e-9
    columns = {TIME_REGRESSOR: t_s / 3600.0, **samples.housekeeping}
    columns = with_steps(fit.parameters.regressors, columns, samples.t_utc)
    return {name: regressor_of(name, columns, samples.h_nt, t_s) for name in fit.parameters.regressors}

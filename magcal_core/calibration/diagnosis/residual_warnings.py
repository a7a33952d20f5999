"""What the residuals of a fit warn of: a search that did not end, outliers, noise that makes |B| too long."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitSettings, FitStatus
from magcal_core.numerics.robust import robust_sigma
from magcal_core.sensor.parameters import Parameters

OUTLIER: Final = 6.0
"""Robust standard deviations beyond which a residual is an outlier worth a warning."""
OUTLIER_SHARE: Final = 0.002
"""Share of outliers that is worth it; of Gaussian noise 2e-9 are beyond."""
SHIFT: Final = 0.5
"""Shift of a scale factor by noise, in its standard errors, that is worth a warning: 95 % intervals hold in 92 then."""


def residual_warnings(
    fit: Fit,
    settings: FitSettings,
    b_nt: Floats,
    standard_errors: Parameters,
    *,
    is_vector: bool,
    is_noise_chosen: bool = False,
) -> Iterator[str]:
    """Yield the warnings of a fit to the field ``b_nt``, shape (n,), nT.

    ``standard_errors``: the honest ones; ``is_noise_chosen``: the noise model was not asked for.
    """
    if fit.status != FitStatus.CONVERGED:
        yield "not_converged: the search ended before it converged"
    if settings.robust == "none":
        size = np.abs(fit.residuals_nt) if not is_vector else np.abs(fit.residuals_nt).max(axis=1)
        limit = OUTLIER * robust_sigma(size)
        count = int(np.count_nonzero(size > limit))
        if limit > 0 and count > OUTLIER_SHARE * len(size):
            yield f"outliers: {count} residuals are beyond {limit:.0f} nT, six robust sigma; consider a robust loss"
    if not is_vector and settings.noise_model == "white" and is_noise_chosen:
        yield (
            "noise_in_scale: noise of the reading made the scale factors too large by more than half their standard "
            "errors; noise_model white has taken it out"
        )
    if not is_vector and settings.noise_model == "none":
        scale, errors = np.abs(fit.parameters.scale), standard_errors.scale
        shift = 2.0 * robust_sigma(fit.residuals_nt) ** 2 / float(np.mean(b_nt**2))
        is_far = shift * scale > SHIFT * errors
        if is_far.any():
            worst = float(np.max(shift * scale[is_far] / errors[is_far]))
            yield (
                f"noise_in_scale: if the residuals are noise, it makes the scale factors {1e6 * shift:.0f} ppm too "
                f"large, {worst:.1f} standard errors; noise_model white takes it out"
            )

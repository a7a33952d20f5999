"""Whether samples determine the nine parameters of a scalar calibration, and which motion would help where not."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.scalar_kernel import geometric_residuals_nt
from magcal_core.calibration.observability.advice import advice, motion_words
from magcal_core.calibration.observability.information import (
    ENOUGH,
    PARAMETER_NAMES,
    SHORT_NAMES,
    UNOBSERVABLE_BELOW,
    condition_number,
    scalar_information,
    sphere_motion,
    taking_part,
)
from magcal_core.errors import NotObservableError
from magcal_core.numerics.robust import robust_sigma
from magcal_core.observations import Observations
from magcal_core.sensor.correction import correct
from magcal_core.sensor.parameterisation import Standardised, lower_of_theta, rows_from_theta, theta_of_parameters

MIN_SAMPLES: Final = 10
"""Nine parameters and one residual: with fewer no error can be estimated."""


def require_samples(observations: Observations) -> None:
    """Refuse fewer samples than the nine parameters and one residual need.

    Raises
    ------
    NotObservableError
    """
    count = int(np.count_nonzero(observations.weights > 0))
    wanted = MIN_SAMPLES + 3 * len(observations.regressors) + observations.rate_nt_s.shape[1]
    if count < wanted:
        raise NotObservableError(
            f"{count} usable samples, the fit needs at least {wanted}: none of {', '.join(SHORT_NAMES)} can be told; "
            "condition number infinite",
            PARAMETER_NAMES,
        )


def require_observable(observations: Observations, theta: Floats, normal: Floats) -> None:
    """Refuse samples that do not excite all nine parameters above the noise.

    Raises
    ------
    NotObservableError
        `ScalarInformation` is below `UNOBSERVABLE_BELOW`, by either index.
    """
    lower = lower_of_theta(theta)
    require_ellipsoid(theta)
    matrix, bias_nt, _ = rows_from_theta(theta, 0)
    x_nt, used = correct(observations.h_nt, bias_nt, lower), observations.weights > 0
    geometric_nt = geometric_residuals_nt(observations.h_nt, observations.b_nt, theta[:9])
    dof = max(int(np.count_nonzero(used)) - 9, 1)
    noise_nt = robust_sigma(geometric_nt[used]) * np.sqrt((dof + 9) / dof)
    information = scalar_information(x_nt[used], matrix, noise_nt)
    if information.is_observable:
        return
    named = taking_part(information.weak[information.ratios < UNOBSERVABLE_BELOW]) or tuple(range(9))
    letters = ", ".join(SHORT_NAMES[i] for i in named)
    raise NotObservableError(
        f"the samples do not determine {letters}: observability index {information.index:.2g}, needed "
        f"{UNOBSERVABLE_BELOW:g}; condition number {condition_number(normal[:9, :9]):.3g}"
        f"{_what_helps(observations, information.index, bias_nt, lower)}",
        [PARAMETER_NAMES[i] for i in named],
    )


def _what_helps(observations: Observations, index: float, bias_nt: Floats, lower: Floats) -> str:
    """Return which motion would determine what the samples do not, as the end of a message."""
    motion = sphere_motion(observations.h_nt, observations.weights, bias_nt, lower)
    used = observations.b_nt[observations.weights > 0]
    duration_s = float(observations.t_s[-1] - observations.t_s[0])
    found = advice(index, motion, used, duration_s)
    return "".join(f"; {one}" for one in (motion_words(motion), *found))


def require_observable_fit(observations: Observations, fit: Fit) -> None:
    """Refuse a fit whose rows with weight do not excite all nine parameters above their noise.

    Raises
    ------
    NotObservableError
        As `require_observable` says.
    """
    step = max(1, len(observations) // ENOUGH)
    plain = replace(observations, weights=fit.weights, regressors={}, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
    none = Standardised.of((), (), len(observations))
    at = replace(fit.parameters, regressors={}, time_offset_s=None)
    normal = fit.blocks.normals.sum(axis=0)
    few = plain.take(slice(None, None, step)) if step > 1 else plain
    require_observable(few, theta_of_parameters(at, none), normal)


def require_ellipsoid(theta: Floats) -> None:
    """Refuse unknowns that no ellipsoid stands behind.

    Raises
    ------
    NotObservableError
        The readings show none.
    """
    if not np.isfinite(rows_from_theta(theta, 0)[0]).all():
        raise NotObservableError("no ellipsoid fits the readings: none of the parameters can be told", PARAMETER_NAMES)

"""The DEKART paper's scalar calibration: Hooke-Jeeves search on its first-order A, then exact parameters [DEKART]_.

Notes
-----
First-order parameters and symmetric A with a positive diagonal are in bijection, so the minimum and the corrected |B|
are those of the exact model; only the reported k and e differ, by up to 1.4 % and 0.65 deg on the paper's own tables.
Both are reported. The search minimises the root of the sum of squares, as printed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitSettings, FitStatus
from magcal_core.calibration.estimators.parts import FirstOrder
from magcal_core.calibration.estimators.scalar import ScalarFit, fit_at
from magcal_core.calibration.estimators.scalar_start import closed_form_starts
from magcal_core.errors import OptionError
from magcal_core.numerics.kernel import kernel
from magcal_core.observations import Observations
from magcal_core.sensor.conventions import first_order_a, first_order_of_a
from magcal_core.sensor.model import inverse_lower, matrix_of_parameters
from magcal_core.sensor.parameterisation import lower_of_theta, rows_from_theta
from magcal_core.sensor.parameters import Parameters

MAX_EVALUATIONS: Final = 200_000
_FIRST_STEP: Final = 0.02
"""Of k, of e in rad, and of b as a share of the field."""
_LAST_STEP: Final = 1e-9
_RESTARTS: Final = 20
_GAIN: Final = 1e-7


@kernel(fastmath={"reassoc", "contract", "nsz"})
def _cost(h: Floats, b: Floats, weight: Floats, p: Floats, sigma: float) -> float:  # pragma: no cover - compiled
    """Return the weighted sum of squares, nT^2, at first-order parameters p = (k, e in rad, b in nT)."""
    a11, a22, a33 = 1.0 / (p[0] * p[0]), 1.0 / (p[1] * p[1]), 1.0 / (p[2] * p[2])
    a12, a13, a23 = -p[3] / (p[0] * p[1]), -p[4] / (p[0] * p[2]), -p[5] / (p[1] * p[2])
    minor = a11 * a22 - a12 * a12
    det = a33 * minor - a11 * a23 * a23 - a22 * a13 * a13 + 2.0 * a12 * a13 * a23
    if not (minor > 0.0 and det > 0.0):
        return math.inf
    total = 0.0
    for i in range(h.shape[0]):
        d1, d2, d3 = h[i, 0] - p[6], h[i, 1] - p[7], h[i, 2] - p[8]
        v1 = a11 * d1 + a12 * d2 + a13 * d3
        v2 = a12 * d1 + a22 * d2 + a23 * d3
        v3 = a13 * d1 + a23 * d2 + a33 * d3
        length = math.sqrt(d1 * v1 + d2 * v2 + d3 * v3)
        r = length - b[i]
        if sigma >= 0.0:
            q = (v1 * v1 + v2 * v2 + v3 * v3) / (length * length)
            r = (r - sigma * sigma * (a11 + a22 + a33 - q) / (2.0 * length)) / math.sqrt(q)
        total += weight[i] * r * r
    return total


@kernel()
def _explore(  # noqa: PLR0917
    h: Floats, b: Floats, weight: Floats, p: Floats, step: Floats, best: float, sigma: float
) -> float:  # pragma: no cover - compiled
    """Try each coordinate up, else down, keep what improves; change ``p`` and return its cost."""
    for i in range(p.size):
        kept = p[i]
        p[i] = kept + step[i]
        cost = _cost(h, b, weight, p, sigma)
        if cost < best:
            best = cost
            continue
        p[i] = kept - step[i]
        cost = _cost(h, b, weight, p, sigma)
        if cost < best:
            best = cost
        else:
            p[i] = kept
    return best


@kernel()
def hooke_jeeves(  # noqa: PLR0917
    h: Floats, b: Floats, weight: Floats, p: Floats, step: Floats, last: float, limit: int, sigma: float
) -> tuple[float, int]:  # pragma: no cover - compiled
    """Search from ``p``, leave the minimum there, and return its cost and the evaluations (at most about ``limit``).

    Exploratory moves about the base, pattern moves x_p = 2 x_new - x_base while they help, steps halved when nothing
    does, until they are ``last`` of what they were.
    """
    base_cost = _cost(h, b, weight, p, sigma)
    evaluations, share = 1, 1.0
    while share > last and evaluations < limit:
        new = p.copy()
        cost = _explore(h, b, weight, new, step, base_cost, sigma)
        evaluations += 2 * p.size
        if not cost < base_cost:
            step *= 0.5
            share *= 0.5
            continue
        while cost < base_cost and evaluations < limit:
            pattern = 2.0 * new - p
            p[:] = new
            base_cost = cost
            new = pattern
            cost = _explore(h, b, weight, new, step, _cost(h, b, weight, new, sigma), sigma)
            evaluations += 2 * p.size + 1
    return base_cost, evaluations


@dataclass(frozen=True, slots=True)
class HookeJeevesFit:
    """The paper's search from the closed-form start; exact parameters, with the paper's own beside them."""

    name: str = "scalar-hooke-jeeves"
    is_vector: bool = False
    takes_regressors: bool = False
    has_moments: bool = True

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate.

        The search has no loss and no noise of its own: robust weights and the noise of the ``white`` model are those of
        the scalar fit to the same samples, which also tells whether the samples determine the parameters.

        Raises
        ------
        NotObservableError
            The samples do not determine the parameters.
        OptionError
            Regressors or a clock offset are asked for: the paper's search has none.
        """
        if observations.regressors or observations.rate_nt_s.shape[1]:
            raise OptionError("scalar-hooke-jeeves fits nine parameters; use scalar for regressors and time offset")
        guide = ScalarFit().fit(observations, replace(settings, start=None))
        sigma = guide.noise_nt
        weighted = replace(observations, weights=np.require(guide.weights, np.float64, ["C", "W"]))
        p, evaluations, is_converged = _search(weighted, settings, sigma)
        theta = _theta(p)
        fit = fit_at(self.name, observations, theta, guide)
        model_minus_measured = -fit.residuals_nt
        printed = FirstOrder(
            bias_nt=p[6:],
            scale=p[:3],
            nonorthogonality_deg=np.rad2deg(p[3:6]),
            mean_nt=float(model_minus_measured.mean()),
            sigma_nt=float(model_minus_measured.std()),
            evaluations=evaluations,
        )
        status = FitStatus.CONVERGED if is_converged else FitStatus.MAX_EVALUATIONS
        return replace(fit, evaluations=evaluations, status=status, first_order=printed)

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate near a known one; by `ScalarFit`, which ends at the same minimum.

        Raises
        ------
        NotObservableError
            The search does not end at a minimum.
        """
        return ScalarFit().refit(observations, settings, near)


def _search(observations: Observations, settings: FitSettings, sigma: float) -> tuple[Floats, int, bool]:
    """Return the first-order parameters at the minimum; the search restarts while that still gains."""
    h, b, w = observations.h_nt, observations.b_nt, observations.weights
    starts = [_first_order(theta) for theta in closed_form_starts(h, b, w)]
    if settings.start is not None:
        s = settings.start
        first = _first_order_of(s.scale, s.nonorthogonality_deg, s.bias_nt)
        starts = [first, *starts]
    p = min(starts, key=lambda start: float(_cost(h, b, w, start, sigma)))
    size_nt = float(np.mean(b))
    first_step = _FIRST_STEP * np.array([*np.abs(p[:3]), 1.0, 1.0, 1.0, size_nt, size_nt, size_nt])
    cost, evaluations, is_converged = np.inf, 0, False
    for restart in range(_RESTARTS):
        step = first_step / 8.0 ** min(restart, 3)
        found, spent = hooke_jeeves(h, b, w, p, step, _LAST_STEP, MAX_EVALUATIONS, sigma)
        evaluations += int(spent)
        is_converged = bool(found >= cost * (1.0 - _GAIN)) or found == 0.0
        cost = min(float(found), cost)
        if is_converged:
            break
    return p, evaluations, is_converged


def _first_order(theta: Floats) -> Floats:
    """Return (k, e in rad, b in nT), first order, of the scalar fit's unknowns."""
    lower = lower_of_theta(theta)
    scale, angles_rad = first_order_of_a(lower.T @ lower)
    return np.concatenate([scale, angles_rad, rows_from_theta(theta, 0)[1]])


def _first_order_of(scale: Floats, angles_deg: Floats, bias_nt: Floats) -> Floats:
    lower = inverse_lower(matrix_of_parameters(scale, np.deg2rad(angles_deg)))
    return np.concatenate([*first_order_of_a(lower.T @ lower), bias_nt])


def _theta(p: Floats) -> Floats:
    """Return the scalar fit's unknowns (L, c) at first-order parameters (k, e, b)."""
    a = first_order_a(p[:3], p[3:6])
    lower = np.linalg.cholesky(a[::-1, ::-1])[::-1, ::-1].T
    return np.concatenate([lower[np.tril_indices(3)], lower @ p[6:]])

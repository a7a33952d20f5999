"""Do sessions agree? Parameters of separate calibrations compared, with honest errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.sessions.hidden_errors import Surrounded, covariance_alone
from magcal_core.errors import OptionError
from magcal_core.numerics.linear_algebra import floored_inverse, scaled_solution
from magcal_core.observations import Observations
from magcal_core.sensor.parameters import Parameters

INCONSISTENT_P: Final = 1e-3
"""Probability, over all comparisons together, below which sessions are said to disagree."""
MOST_DIFFERENCES: Final = 2000
"""Most differences that are told: of many sessions, the most significant ones."""
_NAMED: Final = 4
_FLOOR: Final = 0.1
"""Least eigenvalue of a covariance with a unit diagonal that a test of the parameters together relies on."""
_UNITS: Final[Mapping[str, str]] = {
    "bias_nt": " nT",
    "scale": "",
    "nonorthogonality_deg": " deg",
    "time_offset_s": " s",
}


@dataclass(frozen=True, slots=True, eq=False)
class SessionEstimate:
    """The parameters of one session and their honest covariance, shape (p, p), in the order of their names."""

    label: str
    parameters: Parameters
    covariance: Floats

    @classmethod
    def with_errors(cls, label: str, parameters: Parameters, standard_errors: Parameters) -> SessionEstimate:
        """Return an estimate of which only standard errors are known, as published ones are."""
        return cls(label, parameters, np.diag(standard_errors.vector**2))


@dataclass(frozen=True, slots=True)
class ParameterDifference:
    """One parameter of two sessions: second - first, its standard error, and how many of them that is."""

    parameter: str
    first: str
    second: str
    difference: float
    standard_error: float
    p_value: float

    @property
    def sigmas(self) -> float:
        """Size of the difference in standard errors."""
        return abs(self.difference) / max(self.standard_error, 1e-300)

    def to_dict(self) -> dict[str, object]:
        """Return the difference as records have it."""
        names = ("parameter", "first", "second", "difference", "standard_error", "p_value")
        return {**{name: getattr(self, name) for name in names}, "sigmas": self.sigmas}


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether sessions agree.

    Attributes
    ----------
    chi_square, degrees_of_freedom
        Wald's statistic of all sessions against their common estimate.
    p_value : float
        Probability of a difference as significant as the largest one where there is none, over all comparisons
        (Bonferroni): it holds whatever the correlations, which few blocks cannot tell.
    differences : tuple of ParameterDifference
        Pairs of sessions by parameter, most significant first, at most `MOST_DIFFERENCES`.
    comparisons : int
        How many there are: every pair of sessions and every parameter.
    """

    chi_square: float
    degrees_of_freedom: int
    p_value: float
    differences: tuple[ParameterDifference, ...]
    text: str
    comparisons: int

    @property
    def is_consistent(self) -> bool:
        """Whether nothing speaks against one and the same sensor."""
        return self.p_value >= INCONSISTENT_P

    def to_dict(self) -> dict[str, object]:
        """Return the test as records have it."""
        return {
            "is_consistent": self.is_consistent,
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.degrees_of_freedom,
            "p_value": self.p_value,
            "text": self.text,
            "comparisons": self.comparisons,
            "differences": [difference.to_dict() for difference in self.differences],
        }


def consistency(estimates: Sequence[SessionEstimate]) -> Consistency:
    """Return whether the sessions' parameters agree within their errors; parameters that all of them have are compared.

    Raises
    ------
    OptionError
        Fewer than two sessions.

    Notes
    -----
    chi^2 = sum over sessions of (p_s - p)^T V_s^-1 (p_s - p), p the weighted mean, (S - 1) x parameters degrees of
    freedom. Where V_s stems from few blocks its small eigenvalues are too small; they are raised to a tenth of what
    independent parameters would have.
    """
    from scipy.special import chdtrc

    if len(estimates) < 2:
        raise OptionError("a comparison needs at least two sessions")
    names = _common_names(estimates)
    values, covariances = (np.array(part) for part in zip(*(_selected(one, names) for one in estimates), strict=True))
    differences = _differences(estimates, names, values, np.diagonal(covariances, axis1=1, axis2=2))
    comparisons = len(estimates) * (len(estimates) - 1) // 2 * len(names)
    p_value = min(1.0, comparisons * differences[0].p_value)
    statistic, freedom = _wald(values, covariances), (len(estimates) - 1) * len(names)
    text = _text(differences, comparisons, p_value, float(chdtrc(freedom, statistic)))
    return Consistency(statistic, freedom, p_value, differences, text, comparisons)


def _differences(
    estimates: Sequence[SessionEstimate], names: Sequence[str], values: Floats, variances: Floats
) -> tuple[ParameterDifference, ...]:
    """Return the most significant differences of ``values`` with ``variances``, both of shape (n, p)."""
    from scipy.special import ndtr

    kept: list[NDArray[np.float64]] = []
    for first in range(len(estimates) - 1):
        difference = values[first + 1 :] - values[first]
        error = np.sqrt(variances[first] + variances[first + 1 :])
        second, name = np.divmod(np.arange(difference.size), len(names))
        sigmas = np.abs(difference) / np.maximum(error, 1e-300)
        found = np.array([sigmas.ravel(), np.full(len(name), first), first + 1 + second, name])
        kept = [_largest(np.concatenate([*kept, np.concatenate([found, [difference.ravel(), error.ravel()]])], axis=1))]
    (best,) = kept
    p_values = 2.0 * ndtr(-best[0])
    return tuple(
        ParameterDifference(names[int(k)], estimates[int(i)].label, estimates[int(j)].label, value, error, p)
        for (_, i, j, k, value, error), p in zip(best.T.tolist(), p_values.tolist(), strict=True)
    )


def _largest(differences: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the columns with the largest first entries, largest first, those that are equal in their order."""
    return differences[:, np.argsort(-differences[0], kind="stable")[:MOST_DIFFERENCES]]


def _common_names(estimates: Sequence[SessionEstimate]) -> list[str]:
    shared = set.intersection(*(set(estimate.parameters.names) for estimate in estimates))
    return [name for name in estimates[0].parameters.names if name in shared and name != "time_offset_s"]


def _selected(estimate: SessionEstimate, names: Sequence[str]) -> tuple[Floats, Floats]:
    index = [estimate.parameters.names.index(name) for name in names]
    return estimate.parameters.vector[index], estimate.covariance[np.ix_(index, index)]


def _wald(values: Floats, covariances: Floats) -> float:
    inverses = [floored_inverse(covariance, _FLOOR) for covariance in covariances]
    total = np.sum(inverses, axis=0)
    weighted = np.sum([inverse @ value for inverse, value in zip(inverses, values, strict=True)], axis=0)
    mean = scaled_solution(total, weighted)
    return float(sum((v - mean) @ inverse @ (v - mean) for v, inverse in zip(values, inverses, strict=True)))


def _text(differences: Sequence[ParameterDifference], comparisons: int, p_value: float, chi_p: float) -> str:
    worst = differences[0]
    if p_value >= INCONSISTENT_P:
        return f"the sessions agree: the largest difference is {worst.sigmas:.1f} sigma, in {worst.parameter}"
    told = ", ".join(
        f"{one.parameter} of {one.second} and {one.first} by {one.difference:+.4g}{_unit(one.parameter)}, "
        f"{one.sigmas:.1f} sigma"
        for one in differences[:_NAMED]
        if one.p_value * comparisons < INCONSISTENT_P
    )
    return f"the sessions disagree: {told} (all parameters together p = {chi_p:.1g})"


def _unit(parameter: str) -> str:
    return _UNITS.get(parameter.split("[", maxsplit=1)[0], "")


def consistency_of_fits(
    labels: Sequence[str],
    fits: Sequence[Fit | None],
    sessions: Sequence[Observations],
    surrounded: Sequence[Surrounded] | None = None,
) -> Consistency | None:
    """Return whether separate fits agree within their honest errors; None where there are not two of them.

    ``surrounded``: what is hidden in each session, where that is known.
    """
    around = [None] * len(fits) if surrounded is None else surrounded
    found = [
        SessionEstimate(label, fit.parameters, covariance_alone(fit, session, one))
        for label, fit, session, one in zip(labels, fits, sessions, around, strict=True)
        if fit is not None
    ]
    return consistency(found) if len(found) > 1 else None

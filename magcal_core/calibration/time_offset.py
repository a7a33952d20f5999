"""The clock between telemetry and orbit: its offset (and drift), estimated together with the sensor's parameters.

Notes
-----
A TLE that is some weeks off is wrong mostly along track, which is an error of time. The offset tau is what must be
added to the telemetry's clock. The reference at t + tau + delta is B(t + tau) + delta dB/dt: delta is one more unknown
of the fit, and the reference is computed anew until it vanishes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Estimator, Fit, FitSettings, Observations
from magcal_core.calibration.uncertainty import honest_covariance

Floats = NDArray[np.float64]

AUTO_AGE_DAYS: Final = 3.0
"""Age of an orbit from which on ``auto`` looks for an offset."""
SIGNIFICANCE: Final = 0.04
"""Probability of a false offset that the test allows."""
_ROUNDS: Final = 15
_SMALL_S: Final = 1e-4
_RATE_STEP_S: Final = 0.5
BOUNDED_S: Final = 5.0
"""Standard error of the offset up to which twice as much is harmless: 10 s are 200 nT of |B|."""
LARGEST_S: Final = 3600.0

At = Callable[[Floats], Observations]
"""Seconds to add to each sample's time, shape (n,) -> observations with the reference at those times."""


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """A fit with its clock: offset and, where asked for, drift, each with its honest standard error.

    ``p_value``: probability of an offset so large where there is none.
    """

    fit: Fit
    observations: Observations
    offset_s: float
    offset_error_s: float
    drift_s_per_day: float | None
    drift_error_s_per_day: float | None
    p_value: float
    is_converged: bool

    @property
    def is_significant(self) -> bool:
        """Whether the data show an offset."""
        return self.is_converged and self.p_value < SIGNIFICANCE

    @property
    def detectable_s(self) -> float:
        """Offset, s, that the test finds in 95 % of the sessions that determine it as well as this one."""
        from scipy.special import ndtri

        return float(-(ndtri(SIGNIFICANCE / 2.0) + ndtri(0.05))) * self.offset_error_s

    @property
    def is_bounded(self) -> bool:
        """Whether an offset that the data do not show would be too small to matter."""
        return self.is_converged and self.offset_error_s <= BOUNDED_S

    def to_dict(self) -> dict[str, object]:
        """Return the clock as the records have it."""
        return {
            "offset_s": self.offset_s,
            "standard_error_s": self.offset_error_s,
            "drift_s_per_day": self.drift_s_per_day,
            "drift_standard_error_s_per_day": self.drift_error_s_per_day,
            "p_value": self.p_value,
            "is_significant": self.is_significant,
            "detectable_s": self.detectable_s,
        }


def fit_with_clock(estimator: Estimator, at: At, t_s: Floats, settings: FitSettings, *, has_drift: bool) -> ClockFit:
    """Return the fit with the clock's offset (and drift) among its unknowns; ``t_s``: time of each sample, s, (n,)."""
    from scipy.special import ndtr

    middle = 0.5 * float(t_s[0] + t_s[-1])
    shapes = np.stack([np.ones_like(t_s), t_s - middle]) if has_drift else np.ones((1, len(t_s)))
    clock = np.zeros(len(shapes))
    is_converged, reach_s = False, np.ptp(t_s) / 2
    for _ in range(_ROUNDS):
        observations = _with_rates(at, clock @ shapes, shapes)
        fit = estimator.fit(observations, settings)
        clock = clock + fit.clock
        largest = float(np.abs(fit.clock[0]) + (np.abs(fit.clock[1]) * reach_s if has_drift else 0.0))
        if abs(clock[0]) > LARGEST_S:
            break
        if largest < _SMALL_S:
            is_converged = True
            break
    if is_converged:
        observations, fit = _moved(observations, fit)
    else:
        observations = _with_rates(at, clock @ shapes, shapes)
        fit = estimator.fit(observations, settings)
        clock = clock + fit.clock
    honest = honest_covariance(fit.blocks, fit.covariance, len(observations))
    errors = np.sqrt(np.diag(honest.covariance))[-len(clock) :]
    score = abs(clock[0]) / max(errors[0], 1e-300)
    fit = replace(fit, parameters=replace(fit.parameters, time_offset_s=float(clock[0])))
    return ClockFit(
        fit=fit,
        observations=observations,
        offset_s=float(clock[0]),
        offset_error_s=float(errors[0]),
        drift_s_per_day=float(clock[1] * 86400.0) if has_drift else None,
        drift_error_s_per_day=float(errors[1] * 86400.0) if has_drift else None,
        p_value=float(2.0 * ndtr(-score)),
        is_converged=is_converged,
    )


def _with_rates(at: At, shift_s: Floats, shapes: Floats) -> Observations:
    """Return the observations at ``shift_s`` with the fall of the reference by each unknown of the clock."""
    here, later, sooner = at(shift_s), at(shift_s + _RATE_STEP_S), at(shift_s - _RATE_STEP_S)
    rate = (sooner.b_nt - later.b_nt) / (2 * _RATE_STEP_S)
    base = None
    if here.b_base_nt is not None and sooner.b_base_nt is not None and later.b_base_nt is not None:
        slope = (sooner.b_base_nt - later.b_base_nt) / (2 * _RATE_STEP_S)
        base = np.ascontiguousarray(slope[:, None, :] * shapes.T[:, :, None])
    return replace(here, rate_nt_s=np.ascontiguousarray(rate[:, None] * shapes.T), rate_base_nt_s=base)


def _moved(observations: Observations, fit: Fit) -> tuple[Observations, Fit]:
    """Return observations and residuals with the reference where the fit's own last step of the clock puts it.

    Along its rates: what the curve of the field adds over a step of `_SMALL_S` is some 1e-9 nT.
    """
    along = observations.rate_nt_s @ fit.clock
    base, residuals = observations.b_base_nt, fit.residuals_nt + (along if fit.residuals_nt.ndim == 1 else 0.0)
    if base is not None and observations.rate_base_nt_s is not None:
        along_base = np.einsum("nmi,m->ni", observations.rate_base_nt_s, fit.clock)
        base = np.ascontiguousarray(base - along_base)
        if fit.residuals_nt.ndim == 2:
            residuals = fit.residuals_nt + along_base
    moved = replace(observations, b_nt=observations.b_nt - along, b_base_nt=base)
    return moved, replace(fit, residuals_nt=residuals)

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
from magcal_core.calibration.uncertainty import covered_s, honest_covariance

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
_NEAR_S: Final = 0.5
"""Step up to which the second-order expansion of the reference holds to 1e-5 nT of |B|."""

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


def fit_with_clock(
    estimator: Estimator, at: At, unmoved: Observations, settings: FitSettings, *, has_drift: bool
) -> ClockFit:
    """Return the fit with the clock's offset (and drift) among its unknowns; ``unmoved``: what ``at`` gives for zero.

    Notes
    -----
    Gauss-Newton steps of the clock, each a fit. After a step within `_NEAR_S` the next one is taken on the expansion of
    the reference about the last place; the fit that counts has the reference itself at its own place.
    """
    from scipy.special import ndtr

    t_s = unmoved.t_s
    middle = 0.5 * float(t_s[0] + t_s[-1])
    shapes = np.stack([np.ones_like(t_s), t_s - middle]) if has_drift else np.ones((1, len(t_s)))
    clock = np.zeros(len(shapes))
    is_converged, reach_s, here = False, np.ptp(t_s) / 2, unmoved
    for _ in range(_ROUNDS):
        expansion = _Expansion.about(at, clock @ shapes, here)
        observations = expansion.moved(0.0, shapes)
        fit = estimator.fit(observations, settings)
        clock = clock + fit.clock
        largest = float(np.abs(fit.clock[0]) + (np.abs(fit.clock[1]) * reach_s if has_drift else 0.0))
        if abs(clock[0]) > LARGEST_S:
            break
        if largest < _SMALL_S:
            is_converged = True
            break
        if largest <= _NEAR_S:
            clock = clock + estimator.fit(expansion.moved(fit.clock @ shapes, shapes), settings).clock
        here = at(clock @ shapes)
    if is_converged:
        observations, fit = _moved(observations, fit)
    else:
        observations = _Expansion.about(at, clock @ shapes, at(clock @ shapes)).moved(0.0, shapes)
        fit = estimator.fit(observations, settings)
        clock = clock + fit.clock
    honest = honest_covariance(fit.blocks, fit.covariance, len(observations), covered_s(observations.t_s))
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


@dataclass(frozen=True, slots=True, eq=False)
class _Expansion:
    """The reference about a place of the clock: fall, nT/s, and curvature, nT/s^2, of |B| and of its components."""

    here: Observations
    fall: Floats
    curve: Floats
    base_fall: Floats | None
    base_curve: Floats | None

    @classmethod
    def about(cls, at: At, shift_s: Floats, here: Observations) -> _Expansion:
        """Return the expansion about ``shift_s``, where the observations are ``here``."""
        later, sooner = at(shift_s + _RATE_STEP_S), at(shift_s - _RATE_STEP_S)
        fall, curve = _differences(here.b_nt, later.b_nt, sooner.b_nt)
        base_fall = base_curve = None
        if here.b_base_nt is not None and sooner.b_base_nt is not None and later.b_base_nt is not None:
            base_fall, base_curve = _differences(here.b_base_nt, later.b_base_nt, sooner.b_base_nt)
        return cls(here, fall, curve, base_fall, base_curve)

    def moved(self, step_s: Floats | float, shapes: Floats) -> Observations:
        """Return the observations ``step_s`` on, with the fall of the reference by each unknown of the clock there."""
        step = np.broadcast_to(np.asarray(step_s, np.float64), self.fall.shape)
        fall = self.fall - step * self.curve
        b_nt = self.here.b_nt - step * (self.fall - 0.5 * step * self.curve)
        base_nt, base_rate = self.here.b_base_nt, None
        if base_nt is not None and self.base_fall is not None and self.base_curve is not None:
            along = step[:, None]
            base_nt = base_nt - along * (self.base_fall - 0.5 * along * self.base_curve)
            base_rate = (self.base_fall - along * self.base_curve)[:, None, :] * shapes.T[:, :, None]
            base_rate = np.ascontiguousarray(base_rate)
        rate = np.ascontiguousarray(fall[:, None] * shapes.T)
        return replace(self.here, b_nt=b_nt, b_base_nt=base_nt, rate_nt_s=rate, rate_base_nt_s=base_rate)


def _differences(here: Floats, later: Floats, sooner: Floats) -> tuple[Floats, Floats]:
    """Return fall and curvature of a column from its values `_RATE_STEP_S` later and sooner."""
    return (sooner - later) / (2 * _RATE_STEP_S), ((later - here) + (sooner - here)) / _RATE_STEP_S**2


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

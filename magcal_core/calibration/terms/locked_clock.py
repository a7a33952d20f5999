"""The clock's offset beside errors that are locked to the orbit: looked for whatever the age of the orbit.

Notes
-----
A bias that follows the orbit of a satellite that points is nearly what a clock does that is off; so the offset is one
unknown more of the model of `locked`, with the families beside it. One step at offset 0 tells whether a search is worth
its cost. Each step of a search is the posterior mean, of at most 60 s; the reference is recomputed until it is below
0.01 s. Its error is the posterior one with honest variances, and what an external field does to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.linear_rows import Moments
from magcal_core.calibration.terms.bias_waves import slow_waves, wave_columns
from magcal_core.calibration.terms.clock import BOUNDED_S, SIGNIFICANCE, At, ClockTest
from magcal_core.calibration.terms.locked import locked_terms
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors, reference_shifts
from magcal_core.calibration.uncertainty.honest_covariance import covered_s
from magcal_core.observations import Observations

QUIET: Final = 1.5
"""Standard errors of the first step below which no offset is looked for."""
LONGEST_STEP_S: Final = 60.0
STILL_S: Final = 0.01
LEAST_S: Final = 1.0
"""Smallest offset that is taken, s: smaller ones are within what a reference may be off."""
ORBIT_SIGMAS: Final = 3.0
"""The same in standard deviations of the orbit's own error along track."""
LARGEST_S: Final = 43_200.0
_ROUNDS: Final = 15
RATE_STEP_S: Final = 0.5
_SAME_PERIOD: Final = 0.1
"""Relative difference from the orbit's period, or half of it, within which a wave is one of the families'."""


@dataclass(frozen=True, slots=True, eq=False)
class LockedClock:
    """What was found of the clock.

    Attributes
    ----------
    offset_s, error_s : float
        Offset and standard error, s.
    observations, fit
        The plain fit with the reference at the offset; no unknown of the clock in them.
    is_searched : bool
        Whether the first step was worth a search; where it was not, the offset is that step and the fit is at zero.
    is_converged : bool
    least_s : float
        Smallest offset that may be taken, s.
    wave_periods_s : periods, s, of waves of the bias that are not the orbit's and were unknowns beside it.
    moments : Moments, optional
        Of the fit without the clock, where there was no search: what the locked terms are weighed from.
    """

    offset_s: float
    error_s: float
    observations: Observations
    fit: Fit
    is_searched: bool
    is_converged: bool
    least_s: float
    wave_periods_s: tuple[float, ...] = ()
    moments: Moments | None = None

    @property
    def offset_error_s(self) -> float:
        """Standard error of the offset, s."""
        return self.error_s

    @property
    def test(self) -> ClockTest:
        """The test of the offset."""
        return ClockTest(self.offset_s, self.error_s)

    @property
    def is_significant(self) -> bool:
        """Whether the data show an offset."""
        return self.is_searched and self.is_converged and self.test.p_value < SIGNIFICANCE

    @property
    def is_material(self) -> bool:
        """Whether the data show an offset that matters beside what the orbit may be off along its track."""
        return self.is_significant and abs(self.offset_s) > self.least_s

    @property
    def is_bounded(self) -> bool:
        """Whether an offset that the data do not show would be too small to matter."""
        return self.is_converged and self.error_s <= BOUNDED_S

    def to_dict(self) -> dict[str, object]:
        """Return the clock as the records have it."""
        return {
            **self.test.to_dict(),
            "is_significant": self.is_significant,
            "drift_s_per_day": None,
            "drift_standard_error_s_per_day": None,
            "wave_periods_s": list(self.wave_periods_s),
        }


@dataclass(frozen=True, slots=True, eq=False)
class ClockSearch:
    """What a search for the clock needs.

    Attributes
    ----------
    estimator, settings : the plain fit.
    at : seconds to add to each sample's time -> the samples with the reference at those times.
    columns : the locked columns, of the same samples.
    errors : errors of the reference that a clock does not take up.
    period_s : the orbit's period, s.
    along_s : standard deviation of the orbit's own error along track, s.
    """

    estimator: Estimator
    settings: FitSettings
    at: At
    columns: LockedColumns
    errors: ReferenceErrors | None
    period_s: float | None
    along_s: float

    @property
    def least_s(self) -> float:
        """Smallest offset that may be taken, s."""
        return max(LEAST_S, ORBIT_SIGMAS * self.along_s)

    def glimpse(self, rated: Observations, fit: Fit) -> LockedClock:
        """Return what one step at offset 0 says; ``fit``: the plain one to ``rated``, with the derivative there."""
        step_s, error_s, moments = self._step(rated, fit)
        is_searched = abs(step_s) >= QUIET * error_s
        return LockedClock(
            step_s,
            error_s,
            rated,
            fit,
            is_searched,
            not is_searched,
            self.least_s,
            (),
            moments.without(moments.known - 1),
        )

    def find(self, unmoved: Observations, begin_s: float = 0.0) -> LockedClock:
        """Return the offset that steps from ``begin_s`` on lead to, beside waves of the bias where it shows some."""
        found = self._run(unmoved, begin_s)
        if not found.is_converged:
            return found
        periods_s = tuple(p for p in slow_waves(found.observations, found.fit) if not self._is_locked(p))
        if not periods_s:
            return found
        columns = wave_columns(unmoved.t_s, periods_s)

        def with_waves(shift_s: Floats, rows: slice) -> Observations:
            here = self.at(shift_s, rows)
            return replace(here, regressors={**here.regressors, **{name: one[rows] for name, one in columns.items()}})

        waved = replace(unmoved, regressors={**unmoved.regressors, **columns})
        waving = replace(self, at=with_waves)._run(waved, found.offset_s)
        if not waving.is_converged:
            return found
        here = waving.observations.with_regressors(tuple(unmoved.regressors))
        return replace(waving, observations=here, fit=self.estimator.fit(here, self.settings), wave_periods_s=periods_s)

    def _is_locked(self, period_s: float) -> bool:
        orbit_s = self.period_s
        return orbit_s is not None and any(abs(period_s * turns / orbit_s - 1.0) < _SAME_PERIOD for turns in (1.0, 2.0))

    def _run(self, unmoved: Observations, begin_s: float) -> LockedClock:
        offset_s, settings, is_still, share, before_s = begin_s, self.settings, False, 1.0, 0.0
        for _ in range(_ROUNDS):
            here = unmoved if offset_s == 0.0 else self.at(np.full(len(unmoved), offset_s), slice(None))
            fit = self.estimator.fit(here, settings)
            step_s, error_s, _ = self._step(self._with_rates(offset_s, here), fit)
            # Weights of a loss and sizes of the terms change with the clock: steps may go to and fro between two.
            share = 0.5 * share if step_s * before_s < 0.0 else share
            before_s = step_s
            if abs(share * step_s) < STILL_S:
                is_still = True
                break
            offset_s += share * float(np.clip(step_s, -LONGEST_STEP_S, LONGEST_STEP_S))
            if abs(offset_s) > LARGEST_S:
                break
            settings = replace(self.settings, near=fit if abs(step_s) < 0.5 * LONGEST_STEP_S else None)
        return LockedClock(offset_s, error_s, here, fit, True, is_still, self.least_s)

    def _step(self, observations: Observations, fit: Fit) -> tuple[float, float, Moments]:
        """Return the posterior mean of the clock's step and its standard error, s, and the moments they come from."""
        terms = locked_terms(observations, fit, self.columns, covered_s(observations.t_s), "clock", always=True)
        variance = float(terms.covariance[-1, -1])
        variance += sum(float(one.shift[-1]) ** 2 for one in reference_shifts(self.errors, observations, fit))
        return float(terms.step[-1]), float(np.sqrt(variance)), terms.moments

    def _with_rates(self, offset_s: float, here: Observations) -> Observations:
        n = len(here)
        later, sooner = (self.at(np.full(n, offset_s + step_s), slice(None)) for step_s in (RATE_STEP_S, -RATE_STEP_S))
        return with_derivative(here, later, sooner)


def with_derivative(here: Observations, later: Observations, sooner: Observations) -> Observations:
    """Return ``here`` with the derivative of its reference, from those `RATE_STEP_S` later and sooner."""
    slope = ((sooner.b_nt - later.b_nt) / (2.0 * RATE_STEP_S))[:, None]
    base_slope = None
    if sooner.b_base_nt is not None and later.b_base_nt is not None:
        base_slope = ((sooner.b_base_nt - later.b_base_nt) / (2.0 * RATE_STEP_S))[:, None, :]
    return replace(here, rate_nt_s=np.ascontiguousarray(slope), rate_base_nt_s=base_slope)

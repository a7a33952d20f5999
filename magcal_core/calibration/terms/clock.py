"""The clock between telemetry and orbit: its offset (and drift), estimated together with the sensor's parameters.

Notes
-----
A TLE that is some weeks off is wrong mostly along track, which is an error of time. The offset tau is what must be
added to the telemetry's clock. The reference at t + tau + delta is B(t + tau) + delta dB/dt: delta is one more unknown
of the fit, and the reference is recomputed until it vanishes. Where the residuals show slow waves of the bias, these
are unknowns of the search as well, lest they pass for an offset; the parameters are then those of the plain fit at the
clock that was found.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.observability.information import ENOUGH
from magcal_core.calibration.terms.bias_waves import slow_waves, wave_columns
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, covered_s, honest_covariance
from magcal_core.errors import NotObservableError
from magcal_core.numerics.tails import normal_two_sided
from magcal_core.observations import Observations

AUTO_AGE_DAYS: Final = 3.0
"""Age of an orbit from which on ``auto`` looks for an offset."""
SIGNIFICANCE: Final = 0.03
"""Probability of a false offset that the test allows."""
_DETECTABLE_SIGMAS: Final = 3.8149440045360334
"""Standard errors from zero from which on the test finds an offset in 95 % of sessions: 2.170 for itself and 1.645."""
_ROUNDS: Final = 15
_SMALL_S: Final = 5e-3
"""Step that is the last: the next one would be some 0.1 us long."""
_RATE_STEP_S: Final = 0.5
BOUNDED_S: Final = 5.0
"""Standard error of the offset up to which twice as much is harmless: 10 s are 200 nT of |B|."""
LARGEST_S: Final = 3600.0
_NEAR_S: Final = 0.5
"""Step up to which the second-order expansion of the reference holds to 1e-5 nT of |B|."""
_FAR_S: Final = 30.0
"""Step up to which it holds to some nT, and parameters are those of nearly the same reference."""

At = Callable[[Floats, slice], Observations]
"""Seconds to add to the time of each sample of a slice -> those samples with the reference at those times."""


@dataclass(frozen=True, slots=True)
class ClockTest:
    """Whether data show an offset of the clock: the offset and its standard error, s."""

    offset_s: float
    error_s: float

    @property
    def p_value(self) -> float:
        """Probability of an offset so large where there is none."""
        return normal_two_sided(self.offset_s / max(self.error_s, 1e-300))

    @property
    def detectable_s(self) -> float:
        """Offset, s, that the test finds in 95 % of the sessions that determine it as well as this one."""
        return _DETECTABLE_SIGMAS * self.error_s

    def to_dict(self) -> dict[str, object]:
        """Return the test as the records have it."""
        return {
            "offset_s": self.offset_s,
            "standard_error_s": self.error_s,
            "p_value": self.p_value,
            "is_significant": self.p_value < SIGNIFICANCE,
            "detectable_s": self.detectable_s,
        }


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """A fit with its clock: offset and, where asked for, drift, each with its standard error, of ``honest``.

    ``wave_periods_s``: periods, s, of the waves of the bias that were unknowns beside it.
    """

    fit: Fit
    observations: Observations
    honest: HonestCovariance
    offset_s: float
    offset_error_s: float
    drift_s_per_day: float | None
    drift_error_s_per_day: float | None
    is_converged: bool
    wave_periods_s: tuple[float, ...] = ()

    @property
    def is_significant(self) -> bool:
        """Whether the data show an offset."""
        return self.is_converged and self.test.p_value < SIGNIFICANCE

    @property
    def test(self) -> ClockTest:
        """The test of the offset."""
        return ClockTest(self.offset_s, self.offset_error_s)

    @property
    def is_bounded(self) -> bool:
        """Whether an offset that the data do not show would be too small to matter."""
        return self.is_converged and self.offset_error_s <= BOUNDED_S

    def to_dict(self) -> dict[str, object]:
        """Return the clock as the records have it."""
        return {
            **self.test.to_dict(),
            "is_significant": self.is_significant,
            "drift_s_per_day": self.drift_s_per_day,
            "drift_standard_error_s_per_day": self.drift_error_s_per_day,
            "wave_periods_s": list(self.wave_periods_s),
        }


def fit_with_clock(
    estimator: Estimator,
    at: At,
    unmoved: Observations,
    settings: FitSettings,
    *,
    has_drift: bool,
    start_s: float = 0.0,
) -> ClockFit:
    """Return the fit with the clock's offset (and drift) among its unknowns; ``unmoved``: what ``at`` gives for zero.

    ``start_s``: offset, s, where the search begins.

    Notes
    -----
    Gauss-Newton steps of the clock, each a fit that begins at the one before. Of very many samples some are searched
    first: what is left of the way is then within the reach of one expansion of the reference. A clock that is known is
    searched among waves of the bias once more, where there are any.
    """
    shapes = _shapes(unmoved.t_s, has_drift)
    search = _Search(estimator, at, settings, shapes, slice(None))
    begin = np.zeros(len(shapes))
    begin[0] = start_s
    found = search.begin(unmoved, begin)
    periods_s = slow_waves(found.observations, found.fit) if found.is_converged else ()
    if periods_s:
        # Samples that determine a sensor may not determine one whose bias waves.
        with suppress(NotObservableError):
            waving = _beside_waves(search, unmoved, found, periods_s)
            if waving[0].is_converged:
                return _clock_fit(*waving, periods_s)
    return _clock_fit(found, _honest(found.fit, found.observations), ())


def with_rates(observations: Observations, at: At) -> Observations:
    """Return the observations with the derivative of their reference by the clock; ``at``: of the same samples."""
    n = len(observations)
    later, sooner = (at(np.full(n, step_s), slice(None)) for step_s in (_RATE_STEP_S, -_RATE_STEP_S))
    return _Expansion.about(observations, later, sooner).moved(0.0, np.ones((1, n)))


def _clock_fit(found: _Found, honest: HonestCovariance, periods_s: tuple[float, ...]) -> ClockFit:
    """Return what was ``found``, with the test of its offset."""
    clock = found.clock
    errors = np.sqrt(np.diag(honest.covariance))[-len(clock) :]
    fit = replace(found.fit, parameters=replace(found.fit.parameters, time_offset_s=float(clock[0])))
    has_drift = len(clock) > 1
    return ClockFit(
        fit=fit,
        observations=found.observations,
        honest=honest,
        offset_s=float(clock[0]),
        offset_error_s=float(errors[0]),
        drift_s_per_day=float(clock[1] * 86400.0) if has_drift else None,
        drift_error_s_per_day=float(errors[1] * 86400.0) if has_drift else None,
        is_converged=found.is_converged,
        wave_periods_s=periods_s,
    )


def _honest(fit: Fit, observations: Observations) -> HonestCovariance:
    return honest_covariance(fit.blocks, fit.covariance, len(observations), covered_s(observations.t_s))


def _beside_waves(
    search: _Search, unmoved: Observations, plain: _Found, periods_s: tuple[float, ...]
) -> tuple[_Found, HonestCovariance]:
    """Return the clock that is found with waves of the bias beside it, the plain fit there, and its covariance.

    The plain fit's parameters move with the clock, and so its covariance is what it has at a known clock and what the
    clock's own adds to it.
    """
    columns = wave_columns(unmoved.t_s, periods_s)

    def with_waves(shift_s: Floats, rows: slice) -> Observations:
        here = search.at(shift_s, rows)
        return replace(here, regressors={**here.regressors, **{name: one[rows] for name, one in columns.items()}})

    waving = replace(search, at=with_waves)
    found = waving.begin(replace(unmoved, regressors={**unmoved.regressors, **columns}), plain.clock)
    m = len(found.clock)
    clock_covariance = _honest(found.fit, found.observations).covariance[-m:, -m:]
    shift_s = found.clock @ search.shapes
    here = search.at(shift_s, search.rows)
    fit = search.estimator.fit(here, search.settings)
    near = replace(search.settings, near=fit)
    moves = []
    for shape in search.shapes:
        step = _RATE_STEP_S / float(np.abs(shape).max())
        ends = [search.at(shift_s + sign * step * shape, search.rows) for sign in (1.0, -1.0)]
        later, sooner = (search.estimator.fit(end, near).parameters.vector for end in ends)
        moves.append((later - sooner) / (2.0 * step))
    known = _honest(fit, here)
    return replace(found, observations=here, fit=fit), replace(
        known, covariance=_carried(known.covariance, np.column_stack(moves), clock_covariance)
    )


def _carried(known: Floats, moves: Floats, clock: Floats) -> Floats:
    """Return the covariance of parameters and clock from the former's at a known clock, and their ``moves`` with it."""
    across = moves @ clock
    return np.block([[known + across @ moves.T, across], [across.T, clock]])


def _shapes(t_s: Floats, has_drift: bool) -> Floats:
    """Return how each unknown of the clock moves each sample's time, shape (m, n): offset; drift about the middle."""
    middle = 0.5 * float(t_s[0] + t_s[-1])
    return np.stack([np.ones_like(t_s), t_s - middle]) if has_drift else np.ones((1, len(t_s)))


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Where a search for the clock ended; the observations have the reference at ``clock``."""

    clock: Floats
    observations: Observations
    fit: Fit
    is_converged: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """The search for the clock over the samples ``rows``, whose times ``shapes``, shape (m, rows), move."""

    estimator: Estimator
    at: At
    settings: FitSettings
    shapes: Floats
    rows: slice

    def begin(self, unmoved: Observations, clock: Floats) -> _Found:
        """Return the fit whose clock stands still, from ``clock``; of very many samples, some are searched first."""
        if len(unmoved) < 2 * ENOUGH:
            return self.run(unmoved, clock, None)
        some = slice(None, None, max(1, len(unmoved) // ENOUGH))
        few = replace(self, shapes=np.ascontiguousarray(self.shapes[:, some]), rows=some)
        rough = few.run(unmoved.take(some), clock, None)
        return self.run(unmoved, rough.clock, rough.fit) if rough.is_converged else self.fixed(rough.clock)

    def run(self, unmoved: Observations, clock: Floats, near: Fit | None) -> _Found:
        """Return the fit whose clock stands still, from ``clock``; ``near``: a fit with nearly that clock, if any."""
        is_near = self._largest(clock) <= _NEAR_S
        place = np.zeros_like(clock) if is_near else clock
        here, moved = unmoved if is_near else self._at(place), clock - place
        for _ in range(_ROUNDS):
            expansion = self._expanded(place, here)
            observations, fit, moved = self._along(expansion, moved, near)
            clock, away = place + moved, self._largest(moved)
            if abs(clock[0]) > LARGEST_S:
                break
            if self._largest(fit.clock) < _SMALL_S and away <= _NEAR_S:
                ended = expansion.moved(moved @ self.shapes, self.shapes)
                return _Found(clock, ended, _with_reference_of(ended, observations, fit), True)
            place, here, moved = clock, self._at(clock), np.zeros_like(clock)
            near = fit if away <= _FAR_S else None
        return self.fixed(clock)

    def fixed(self, clock: Floats) -> _Found:
        """Return the fit with the reference at ``clock``, to which no search has converged."""
        observations = self._expanded(clock, self._at(clock)).moved(0.0, self.shapes)
        fit = self.estimator.fit(observations, self.settings)
        return _Found(clock + fit.clock, observations, fit, False)

    def _along(self, expansion: _Expansion, moved: Floats, near: Fit | None) -> tuple[Observations, Fit, Floats]:
        """Return the last fit along an expansion, from ``moved`` on, with its observations and where it leads."""
        for _ in range(_ROUNDS):
            observations = expansion.moved(moved @ self.shapes, self.shapes)
            fit = self.estimator.fit(observations, replace(self.settings, near=near))
            near, moved = fit, moved + fit.clock
            away = self._largest(moved)
            if away > _FAR_S or self._largest(fit.clock) < (_SMALL_S if away <= _NEAR_S else _NEAR_S):
                break
        return observations, fit, moved

    def _largest(self, clock: Floats) -> float:
        """Return the most, s, by which ``clock`` moves a sample's time."""
        return float(np.abs(clock) @ np.abs(self.shapes[:, [0, -1]]).max(axis=1))

    def _at(self, clock: Floats) -> Observations:
        return self.at(clock @ self.shapes, self.rows)

    def _expanded(self, clock: Floats, here: Observations) -> _Expansion:
        shift_s = clock @ self.shapes
        later, sooner = (self.at(shift_s + step_s, self.rows) for step_s in (_RATE_STEP_S, -_RATE_STEP_S))
        return _Expansion.about(here, later, sooner)


@dataclass(frozen=True, slots=True, eq=False)
class _Expansion:
    """The reference about a place of the clock: -d/dt, nT/s, and curvature, nT/s^2, of |B| and of its components."""

    here: Observations
    slope: Floats
    curve: Floats
    base_slope: Floats | None
    base_curve: Floats | None

    @classmethod
    def about(cls, here: Observations, later: Observations, sooner: Observations) -> _Expansion:
        """Return the expansion about ``here``, from the observations `_RATE_STEP_S` later and sooner."""
        slope, curve = _differences(here.b_nt, later.b_nt, sooner.b_nt)
        base_slope = base_curve = None
        if here.b_base_nt is not None and sooner.b_base_nt is not None and later.b_base_nt is not None:
            base_slope, base_curve = _differences(here.b_base_nt, later.b_base_nt, sooner.b_base_nt)
        return cls(here, slope, curve, base_slope, base_curve)

    def moved(self, step_s: Floats | float, shapes: Floats) -> Observations:
        """Return the observations ``step_s`` on, with the derivative of the reference by each unknown there."""
        step = np.broadcast_to(np.asarray(step_s, np.float64), self.slope.shape)
        slope = self.slope - step * self.curve
        b_nt = self.here.b_nt - step * (self.slope - 0.5 * step * self.curve)
        base_nt, base_rate = self.here.b_base_nt, None
        if base_nt is not None and self.base_slope is not None and self.base_curve is not None:
            along = step[:, None]
            base_nt = base_nt - along * (self.base_slope - 0.5 * along * self.base_curve)
            base_rate = (self.base_slope - along * self.base_curve)[:, None, :] * shapes.T[:, :, None]
            base_rate = np.ascontiguousarray(base_rate)
        rate = np.ascontiguousarray(slope[:, None] * shapes.T)
        return replace(self.here, b_nt=b_nt, b_base_nt=base_nt, rate_nt_s=rate, rate_base_nt_s=base_rate)


def _differences(here: Floats, later: Floats, sooner: Floats) -> tuple[Floats, Floats]:
    """Return -d/dt and curvature of a column from its values `_RATE_STEP_S` later and sooner."""
    return (sooner - later) / (2 * _RATE_STEP_S), ((later - here) + (sooner - here)) / _RATE_STEP_S**2


def _with_reference_of(ended: Observations, before: Observations, fit: Fit) -> Fit:
    """Return ``fit`` to the observations ``before`` with the residuals it has beside the reference of ``ended``."""
    if fit.residuals_nt.ndim == 2:
        residuals_nt = fit.residuals_nt + (before.require_vector() - ended.require_vector())
    else:
        residuals_nt = fit.residuals_nt + (before.b_nt - ended.b_nt)
    return replace(fit, residuals_nt=residuals_nt)

"""The state of a sensor's parameters at any time, from a history that is explained, in shares and their own units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.sessions.field_change import field_jacobian
from magcal_core.calibration.sessions.trend_changes import Explained
from magcal_core.calibration.sessions.trend_filter import Passes, both_passes
from magcal_core.calibration.sessions.trend_life import DAYS_A_YEAR, bound_nt
from magcal_core.calibration.sessions.trend_mixture import standard_error
from magcal_core.sensor.parameters import GROUPS, Parameters

NAMES: Final = tuple(f"{group}[{i}]" for group in GROUPS for i in range(3))
NS_A_YEAR: Final = DAYS_A_YEAR * 86400e9
_HEAVY: Final = 1e-7
"""Posterior, against the heaviest, below which a point of the grid is left out of the mixture."""
_AT_ONCE: Final = 512


@dataclass(frozen=True, slots=True, eq=False)
class TrendStates:
    """The sensor at some times: shapes (m, 9), (m, 9), (m, 9, 9) and (m,); without the m for a single time.

    ``parameters``, ``standard_errors`` and ``covariance`` in the units and the order of `NAMES`; ``field_error_nt``:
    what the corrected field is off by at most in 95 of 100 cases, root mean square over all directions.
    """

    t_utc: Times
    parameters: Floats
    standard_errors: Floats
    covariance: Floats
    field_error_nt: Floats

    def one(self, index: int) -> TrendStates:
        """Return the state at one of the times."""
        values = (self.t_utc, self.parameters, self.standard_errors, self.covariance, self.field_error_nt)
        return TrendStates(*(np.asarray(value[index]) for value in values))


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A history explained, in shares, and how to get from there to parameters.

    ``centre``, ``unit``, shape (9,): parameter = centre + unit x share.
    """

    explained: Explained
    whole: Passes
    centre: Floats
    unit: Floats
    metric: Floats
    first_ns: int

    @classmethod
    def of(cls, explained: Explained, centre: Floats, unit: Floats, field_nt: float, first_ns: int) -> Smoothed:
        """Return the smoothed history; ``field_nt``: the field that its errors are given for."""
        walks, scatters = (np.repeat(one, 3) for one in explained.mean_squares())
        at = Parameters(centre[:3], centre[3:6], centre[6:9])
        jacobian = field_jacobian(at, field_nt) * unit
        whole = both_passes(explained.history, walks, scatters, by_group=False)
        return cls(explained, whole, centre, unit, jacobian.T @ jacobian * 3.0 / len(jacobian), first_ns)

    @property
    def span_years(self) -> float:
        """From the first to the last set that counts."""
        return float(self.explained.history.years[-1] - self.explained.history.years[0])

    def years_of(self, t_utc: Times) -> Floats:
        """Return times as years from the first of all sets."""
        return np.asarray((t_utc.astype("datetime64[ns]").astype(np.int64) - self.first_ns) / NS_A_YEAR)

    def time_of(self, years: float) -> np.datetime64:
        """Return a time from years."""
        return np.datetime64(self.first_ns + round(years * NS_A_YEAR), "ns")

    def shares_at(self, years: Floats) -> tuple[Floats, Floats]:
        """Return the state in shares at ``years``, shape (m,): means (m, 9) and covariances (m, 9, 9)."""
        posterior = self.explained.weights
        heavy = np.flatnonzero((posterior > _HEAVY * posterior.max(axis=1, keepdims=True)).any(axis=0))
        passes, weights = self.explained.passes.of_grid(heavy), posterior[:, heavy]
        weights = weights / weights.sum(axis=1, keepdims=True)
        parts = [
            self._of_mixture(passes, weights, part)
            for part in np.array_split(years, max(1, -(-len(years) // _AT_ONCE)))
        ]
        means, covariances = (np.concatenate(one) for one in zip(*parts, strict=True))
        return means, covariances

    def _of_mixture(self, passes: Passes, weights: Floats, years: Floats) -> tuple[Floats, Floats]:
        """Return the state in shares at ``years``: means and errors of the mixture, correlations of one filter."""
        means, covariances = passes.at(years)
        by_grid = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
        mean, error = np.empty((len(years), 9)), np.empty((len(years), 9))
        for group in range(3):
            of = slice(3 * group, 3 * group + 3)
            mean[:, of], error[:, of] = standard_error(weights[group], means[:, group], by_grid[:, group])
        _, covariance = self.whole.at(years)
        size = error / np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        return mean, covariance * size[:, :, None] * size[:, None, :]

    def at(self, t_utc: Times) -> TrendStates:
        """Return the state at times, shape (m,)."""
        means, covariances = self.shares_at(self.years_of(t_utc))
        covariance = covariances * np.outer(self.unit, self.unit)
        errors = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        bounds = bound_nt(self.metric, np.zeros_like(means), covariances)
        return TrendStates(t_utc, self.centre + means * self.unit, errors, covariance, bounds)

    def bounds_nt(self, parameters: Floats, years: Floats) -> Floats:
        """Return the bound of the field's error of a set with ``parameters``, shape (9,), at ``years``, nT."""
        means, covariances = self.shares_at(years)
        return bound_nt(self.metric, (parameters - self.centre) / self.unit - means, covariances)

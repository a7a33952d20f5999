"""How many columns of the orbit's period can be told from a slow change of the bias at all, whatever the rule.

A test that no calibration can make: it knows the law and the size of all else that moves the bias, and asks whether the
readings are those of the column or of another bias of its spectrum. What this cannot tell no rule can, and what a rule
takes beyond it is luck. ``MAGCAL_DECOYS`` sets the number of sessions of each kind, ``MAGCAL_SEEDS_FROM`` the number
that their seeds begin at.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve, toeplitz

from benchmarks.measure import Figure
from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.search import period_of
from magcal_core.calibration.estimators.linear_rows import rows_of
from magcal_core.estimation.estimate import Prepared
from magcal_core.estimation.start_and_loss import started
from magcal_core.field.sources import FieldSources
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced
from tests.magcal_core.decoys import ERRORS, STEP_S, Session, draw, smoothed

IS_STUDY = True
ROOM: Final = "column_bound"
SESSIONS: Final = 9
ODDS: Final = 3.0
"""Logarithm of the odds, 20 to 1, from which on the column is told."""
NOISE_NT: Final = 60.0
ERROR_NT: Final = 100.0
SLOPE_NT_K: Final = 17.5
"""Middle of the sizes that are drawn, nT/K."""
MINUTES: Final = (42.0, 150.0)
_FLAT: Final = 1e4
"""Variance, over that of the residual, of what is not known beforehand: the sensor's parameters."""


def covariance_of(error: str, n: int, orbit_s: float) -> Floats:
    """Return the covariance, shape (n, n), nT^2, of the error ``error`` of one axis of the bias, as it is drawn."""
    lag_s, square = STEP_S * np.arange(n), ERROR_NT**2
    if error == "memory":
        return np.asarray(square * toeplitz(np.exp(-lag_s / 900.0)))
    if error == "walk":
        steps = np.arange(1, n + 1)
        return np.asarray(square / n * np.minimum.outer(steps, steps))
    if error == "wave":
        periods_s = 60.0 * np.geomspace(MINUTES[0], MINUTES[1], 60)
        waves = np.cos(2.0 * np.pi * lag_s / periods_s[:, None]).mean(axis=0)
        return np.asarray(square / 6.0 * toeplitz(waves))
    if error == "heat":
        each = round(orbit_s / STEP_S)
        t_s = STEP_S * np.arange(4 * each)
        lit = smoothed(np.clip(3.0 * np.sin(2.0 * np.pi * t_s / orbit_s) + 1.0, -1.0, 1.0), 600.0)[-each:]
        lit = lit - lit.mean()
        shifted = np.array([np.mean(lit * np.roll(lit, k)) for k in range(each)])
        return np.asarray(square / 3.0 * toeplitz(shifted[np.arange(n) % each]))
    return np.zeros((n, n))


def log_odds(session: Session, error: str) -> float:
    """Return the logarithm of the odds of the true column against another bias of its spectrum."""
    options = CalibrationOptions()
    flown = session.flown
    sources = FieldSources.of(None, None)
    prepared = Prepared.of(Referenced.of(flown.sent(), [flown.orbit], options, sources), options)
    estimate = started(prepared)
    (channel,) = rows_of(estimate.observations, estimate.fit).channels
    orbit_s, n = period_of(flown.orbit, flown.samples.t_utc[0]), len(channel.y)
    jacobian = channel.jacobian / np.sqrt(np.mean(channel.jacobian**2, axis=0))
    carried = channel.carriers @ channel.carriers.T / channel.sigma_nt**2
    known = (NOISE_NT / channel.sigma_nt) ** 2 * np.eye(n) + _FLAT * jacobian @ jacobian.T
    known = known + carried * covariance_of(error, n, orbit_s)
    column = session.columns[session.true]
    column = column - column.mean()
    size = SLOPE_NT_K**2 / 3.0
    turn, way = 2.0 * np.pi * STEP_S * np.arange(n) / orbit_s, np.linspace(-0.5, 0.5, n)
    # Of the columns as they are drawn: 10 K, half of 0 to 4 K squared, a third of 3 K squared.
    spectrum = toeplitz(50.0 * np.cos(turn) + 16.0 / 6.0 * np.cos(2.0 * turn)) + 3.0 * np.outer(way, way)
    ours = _log_likelihood(known + carried * size * np.outer(column, column), channel.y)
    return ours - _log_likelihood(known + carried * size * spectrum, channel.y)


def _log_likelihood(covariance: Floats, y: Floats) -> float:
    factor = cho_factor(covariance, lower=True)
    return -float(np.log(np.diag(factor[0])).sum()) - 0.5 * float(y @ cho_solve(factor, y))


def figures() -> Iterator[Figure]:
    """Yield, beside each error of the bias, how many temperatures of the orbit's period can be told."""
    sessions = int(os.environ.get("MAGCAL_DECOYS", SESSIONS))
    begin = int(os.environ.get("MAGCAL_SEEDS_FROM", "0"))
    every: list[bool] = []
    for error in ERRORS:
        told = [log_odds(draw(begin + i, error, "temperature"), error) >= ODDS for i in range(sessions)]
        every += told
        share = 100.0 * float(np.mean(told))
        yield Figure(
            ROOM, f"{error} error: temperature that can be told", share, "%", "", None, f"{len(told)} sessions"
        )
    share = 100.0 * float(np.mean(every))
    yield Figure(ROOM, "temperature that can be told, of all", share, "%", "", None, f"{len(every)} sessions")

"""How far a parameter set is from the state of the sensor in the field that it gives, and how long that is enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats

_HELD: Final = 0.95
_MOST_SPANS: Final = 2.0
"""Longest life that is given, in spans of the history: beyond it nothing was ever seen."""
_STEPS: Final = 256
DAYS_A_YEAR: Final = 365.25


@dataclass(frozen=True, slots=True)
class Life:
    """How long a parameter set stays good.

    Attributes
    ----------
    parameter_set_id : str or None
    share : share of the field that the error's bound may not pass.
    days : from the time asked for until it does; None where that cannot be told.
    is_capped : whether ``days`` is the longest that may be said: "at least".
    until : ISO 8601, UTC; None where ``days`` is.
    text : in words.
    """

    parameter_set_id: str | None
    share: float
    days: float | None
    is_capped: bool
    until: str | None
    text: str

    def to_dict(self) -> dict[str, object]:
        """Return the life as the trend's record has it."""
        return {name: getattr(self, name) for name in self.__slots__}


def bound_nt(metric: Floats, difference: Floats, covariance: Floats) -> Floats:
    """Return the bound, nT, that the field's error stays below in 95 of 100 cases, shape (m,).

    ``metric``: M, shape (9, 9), nT^2; ``difference``: parameters less the state, shape (m, 9); ``covariance`` of the
    state, shape (m, 9, 9).

    Notes
    -----
    The mean square error e = tr(M P) + d' M d has the variance v = 2 tr(M P M P) + 4 d' M P M d. A multiple of a
    chi-square with h = 2 e^2 / v degrees of freedom has the same two moments (Satterthwaite).
    """
    from scipy.special import gammaincinv

    spread = metric @ covariance
    moved = difference @ metric
    size = np.einsum("mii->m", spread) + np.sum(moved * difference, axis=1)
    noise = 2.0 * np.einsum("mij,mji->m", spread, spread) + 4.0 * np.einsum("mi,mij,mj->m", moved, covariance, moved)
    freedom = 2.0 * size**2 / noise
    return np.asarray(np.sqrt(size * 2.0 * gammaincinv(0.5 * freedom, _HELD) / freedom))


def life_years(span_years: float) -> Floats:
    """Return the times, years from the beginning of a life, that the bound is read off at, shape (257,)."""
    return np.asarray(_MOST_SPANS * span_years * np.linspace(0.0, 1.0, _STEPS + 1) ** 2)


def years_within(years: Floats, bounds: Floats, limit: float) -> tuple[float, bool]:
    """Return how long ``bounds``, read off at ``years``, stay within ``limit``, and whether they do to the end."""
    # The largest so far, so that a larger limit never shortens a life.
    highest = np.maximum.accumulate(bounds)
    beyond = np.flatnonzero(highest > limit)
    if not len(beyond):
        return float(years[-1]), True
    i = int(beyond[0])
    if i == 0:
        return 0.0, False
    part = (limit - highest[i - 1]) / (highest[i] - highest[i - 1])
    return float(years[i - 1] + part * (years[i] - years[i - 1])), False


def life_text(days: float | None, share: float, *, is_capped: bool, why_none: str) -> str:
    """Return the life in words."""
    within = f"{100.0 * share:.3g} %"
    if days is None:
        return f"how long it stays good to within {within} cannot be told: {why_none}"
    if days == 0.0:
        return f"no longer good to within {within}"
    return f"good for {'at least ' if is_capped else ''}{days:.0f} d to within {within}"

"""Which loss a fit is made under: none where the data are clean, else one that begins at least trimmed squares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.robust_start import RobustStart, scalar_start, scale_of, vector_start
from magcal_core.calibration.estimators.scalar_gate import require_observable_fit
from magcal_core.calibration.estimators.vector_rows import whole_residuals_nt
from magcal_core.errors import EstimationError, FrameError, NotObservableError
from magcal_core.observations import Observations

AUTO: Final = "auto"
AUTO_LOSS: Final = "tukey"
WORTH_A_LOOK: Final = 0.005
"""Scale, as a share of |B|, from which on something may be behind it."""
CLEAN_SHARE: Final = 0.01
"""Scale of the residuals, as a share of median |B|, below which a session may be clean."""
CLEAN_REACH: Final = 6.0
"""Scales within which every residual of a clean session lies."""
INLIER_REACH: Final = 5.0
_FLOOR: Final = 1e-7
"""Scale, as a share of |B|, that rounding may be taken for: 4 pT at 40 uT."""
_ENOUGH: Final = 20_000
_UNKNOWNS: Final = 9


@dataclass(frozen=True, slots=True)
class LossUse:
    """The loss that was asked for and the one that was used, where its search began, and what the good rows show.

    ``start``: ``plain`` or ``lts``; ``scale_nt``: robust scale of the residuals, nT; ``inlier_share``: share of the
    rows within five scales.
    """

    asked: str
    used: str
    start: str
    scale_nt: float
    inlier_share: float

    def to_dict(self) -> dict[str, object]:
        """Return the loss as the records have it."""
        return {name: getattr(self, name) for name in self.__slots__}


@dataclass(frozen=True, slots=True, eq=False)
class LossFit:
    """A fit, and the settings that later fits to the same rows go on with; ``is_clean``: no row needs a loss."""

    fit: Fit
    settings: FitSettings
    start: str
    is_clean: bool

    def use(self, asked: str, fit: Fit, observations: Observations) -> LossUse:
        """Return what the record says of the loss of ``fit``, which may be a later one to the same rows."""
        scale_nt, share = inliers(fit.residuals_nt, observations.weights)
        return LossUse(asked, self.settings.robust, self.start, scale_nt, share)


def fit_under_loss(estimator: Estimator, observations: Observations, settings: FitSettings) -> LossFit:
    """Return the fit under ``settings.robust``; of `AUTO` the plain one where the data are clean, else Tukey's.

    Of |B| alone nothing is refused for want of observability: that is asked once the loss has put bad rows aside. The
    vector methods test each axis against the errors of the rows that have weight, and are gated here.

    Raises
    ------
    EstimationError
        No estimate can be made at all.
    """
    asked, free = settings.robust, replace(settings, robust="none", is_gated=estimator.is_vector)
    try:
        plain: Fit | None = estimator.fit(observations, free)
    except (EstimationError, FrameError, np.linalg.LinAlgError):
        if asked == "none":
            raise
        plain = None
    if asked == "none" and plain is not None:
        return LossFit(plain, replace(settings, robust="none"), "plain", False)
    is_seen_clean = plain is not None and is_clean(estimator, observations, plain)
    if is_seen_clean and plain is not None and asked == AUTO:
        return LossFit(plain, replace(settings, robust="none"), "plain", True)
    loss = AUTO_LOSS if asked == AUTO else asked
    begin = None if is_seen_clean else start_of(observations, is_vector=estimator.is_vector)
    chosen = replace(settings, robust=loss, begin=begin)
    fit = estimator.fit(observations, replace(chosen, is_gated=estimator.is_vector))
    return LossFit(fit, chosen, "plain" if begin is None else "lts", is_seen_clean)


def start_of(observations: Observations, *, is_vector: bool) -> RobustStart | None:
    """Return where a loss begins that half of the rows may be wrong for; None where the rows show no sensor at all."""
    used = observations.weights > 0
    h_nt = observations.h_nt[used]
    if is_vector:
        found = vector_start(h_nt, observations.require_vector()[used])
    else:
        found = scalar_start(h_nt, observations.b_nt[used])
    if found is None or used.all():
        return found
    weights = np.zeros(len(used))
    weights[used] = found.weights
    return replace(found, weights=weights)


def is_clean(estimator: Estimator, observations: Observations, plain: Fit) -> bool:
    """Return whether the plain fit leaves no row that a loss would reject, and determines the sensor.

    Scale below 1 % of median |B|, every residual within six scales, and, of |B| alone, observable by both indices. A
    turned reference makes residuals that no row is to blame for: of vectors, those of T with all nine elements count
    as well, and noise of the attitude may exceed that 1 % where least trimmed squares see no smaller scale.
    """
    used = observations.weights > 0
    if not estimator.is_vector:
        try:
            require_observable_fit(observations, plain)
        except NotObservableError:
            return False
        return _is_within(plain.residuals_nt[used], observations.b_nt[used], CLEAN_SHARE)
    field_nt = observations.b_nt[used]
    if _is_within(plain.residuals_nt[used], field_nt, CLEAN_SHARE):
        return True
    whole_nt = whole_residuals_nt(observations)[used]
    if _is_within(whole_nt, field_nt, CLEAN_SHARE):
        return True
    if not _is_within(whole_nt, field_nt, np.inf):
        return False
    start = start_of(observations, is_vector=True)
    scale_nt = float(np.sqrt(np.mean([scale_of(axis) ** 2 for axis in whole_nt.T])))
    return start is not None and start.scale_nt > 0.8 * scale_nt


def _is_within(residuals_nt: Floats, b_nt: Floats, share: float) -> bool:
    """Return whether residuals, shape (n,) or (n, 3), lie within the reach of their scale, and that below ``share``."""
    field_nt = float(np.median(b_nt[:: max(1, len(b_nt) // _ENOUGH)]))
    columns = residuals_nt.reshape(len(b_nt), -1)
    for column in columns.T:
        some = column[:: max(1, len(column) // _ENOUGH)]
        # With few rows the parameters take their part of the residuals.
        scale_nt = scale_of(some) * len(some) / max(len(some) - _UNKNOWNS, 1)
        scale_nt = max(scale_nt, _FLOOR * field_nt)
        if not is_clean_within(column, scale_nt, field_nt, share):
            return False
    return True


def is_clean_within(residuals_nt: Floats, scale_nt: float, field_nt: float, share: float = CLEAN_SHARE) -> bool:
    """Return whether residuals, shape (n,), nT, lie within the reach of their scale, and that below ``share``."""
    return scale_nt < share * field_nt and max(residuals_nt.max(), -residuals_nt.min()) <= CLEAN_REACH * scale_nt


def counted_weights(fit: Fit, robust: str) -> Floats:
    """Return the weights of ``fit``, shape (n,), with zero for rows so far off that no statistic should count them.

    Tukey's loss takes their weight away itself; the others leave them some.
    """
    if robust in ("none", AUTO_LOSS):
        return fit.weights
    r = fit.residuals_nt.reshape(len(fit.weights), -1)
    used = fit.weights > 0
    scales = np.array([scale_of(column[used]) for column in r.T])
    return np.where((np.abs(r) <= CLEAN_REACH * np.maximum(scales, 1e-300)).all(axis=1), fit.weights, 0.0)


def inliers(residuals_nt: Floats, weights: Floats) -> tuple[float, float]:
    """Return the robust scale of residuals, shape (n,) or (n, 3), nT, and the share of rows within five scales."""
    used = weights > 0
    r = (residuals_nt if used.all() else residuals_nt[used]).reshape(int(np.count_nonzero(used)), -1)
    step = max(1, len(r) // _ENOUGH)
    scales = np.array([scale_of(column[::step]) for column in r.T])
    is_near = (np.abs(r) <= INLIER_REACH * np.maximum(scales, 1e-300)).all(axis=1)
    return float(np.sqrt(np.mean(scales**2))), float(np.mean(is_near))

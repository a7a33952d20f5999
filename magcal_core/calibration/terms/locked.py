"""Errors of the bias that are locked to the orbit or the attitude: what they may have done to the parameters.

Notes
-----
Such an error sits at frequency zero of the scores, which the fit has set to zero: no residual shows it, and intervals
from residuals alone are too small. Here it stands beside the parameters with an a-priori size that the data weigh
(`evidence`), over columns that follow the orbit, heat and light (`locked_columns`). The covariance always knows of
them. The estimate moves by their mean only where every unseen block of time is predicted better for it: on a satellite
that turns once per orbit, such terms are nearly the field itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Moments, rows_of
from magcal_core.calibration.terms.evidence import SIZES
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.terms.locked_posterior import DRIFT
from magcal_core.calibration.terms.locked_rows import FamilyRecord, LockedModel, held_out, softening_of
from magcal_core.calibration.uncertainty.cross_validation import folds_of
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance, with_blocks
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameters import Parameters

Kind = Literal["fit", "clock", "full"]

CERTAIN: Final = 0.95
"""Probability of a family from which on a warning names it."""
BETTER: Final = 0.97
"""Median ratio of the held-out residuals, with terms over without, below which the estimate may move."""
MOVE_ERROR: Final = 0.3
"""Standard error of a move that is made, as a share of it."""
FEW_SIZES: Final = (0.0, 0.3, 3.0)
"""Sizes of a family that are tried where the clock alone is asked for."""
BLOCKS: Final = 64
"""Most blocks whose scores honest errors are taken from."""
_ROUNDS: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class LockedTerms:
    """The estimate and its covariance with locked errors considered.

    Attributes
    ----------
    parameters : Parameters
        The fit's, or where they have moved to; those of T_low where all nine elements were unknown.
    matrix : shape (3, 3)
        T at the estimate; full where all nine elements were unknown.
    unknown_covariance : shape (q, q)
        Covariance of the elements of T, the bias and the rest, as `Rows.unknowns` has them.
    covariance : shape (p, p)
        The same of the parameters, in the order of `Parameters.names`; honest variances, no error of the reference.
    widening : shape (p,)
        Honest over posterior standard error (r), at least 1.
    families : name -> FamilyRecord
    effective_share : float
        k.
    moved : bool
    held_out : shape (m,)
        Residual of each unseen block with terms over without.
    unseen_sun_nt : float
        What a term that follows the sun may have across the field, nT; 0 where none is seen or attitude is known.
    plain : Parameters
        Those without any term.
    step : shape (q,)
        Change of the elements of T, the bias and the rest against the fit.
    columns : LockedColumns
        What was held against.
    moments : Moments
        Of the rows about the estimate.
    softening : float
        What a robust loss divides their normal matrix by.
    """

    parameters: Parameters
    matrix: Floats
    unknown_covariance: Floats
    covariance: Floats
    widening: Floats
    families: Mapping[str, FamilyRecord]
    effective_share: float
    moved: bool
    held_out: Floats
    unseen_sun_nt: float
    plain: Parameters
    step: Floats
    columns: LockedColumns
    moments: Moments
    softening: float

    @property
    def shift(self) -> Floats:
        """Estimate less the plain one, shape (p,), in the order of `Parameters.names`."""
        return self.parameters.vector - self.plain.vector

    def honest(self, fit: Fit, samples: int, duration_s: float) -> HonestCovariance:
        """Return the covariance with the blocks of ``fit``, whose samples cover ``duration_s``, s."""
        return with_blocks(self.covariance, fit.blocks, samples, duration_s)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Which families are certain, and that a part of the sun's is not seen."""
        found = [
            f"bias_locked: the bias {_WORDS[name].format(size=f'{family.rms_nt:.0f} nT root mean square')}"
            for name, family in self.families.items()
            if family.probability > CERTAIN
        ]
        if self.unseen_sun_nt > 0.0:
            found.append(
                f"sun_locked: a bias that follows the sun may have {self.unseen_sun_nt:.0f} nT across the field that "
                "|B| does not show; attitude or the panels' currents would"
            )
        return tuple(found)

    def to_dict(self) -> dict[str, object]:
        """Return the terms as the records have them."""
        return {
            "families": {name: family.to_dict() for name, family in self.families.items()},
            "effective_share": self.effective_share,
            "moved": self.moved,
            "held_out": self.held_out.tolist(),
            "unseen_sun_nt": self.unseen_sun_nt,
            "shift": self.plain.with_vector(self.shift).to_dict(),
            "plain": self.plain.to_dict(),
        }


_CURE: Final = "({size} in the residual); give the temperature or the currents as regressors"
_WORDS: Final = {
    "orbit": f"follows the orbital period {_CURE}",
    "heat": f"follows light and shadow {_CURE}",
    "sun": f"follows the direction of the sun {_CURE}",
    DRIFT: "drifts over the session ({size} in the residual); bias_nt is its mean, shorter sessions follow it",
}


def locked_terms(
    observations: Observations,
    fit: Fit,
    columns: LockedColumns,
    duration_s: float,
    kind: Kind = "fit",
    *,
    always: bool = False,
    never: bool = False,
    known: Moments | None = None,
) -> LockedTerms:
    """Return the estimate with errors locked to ``columns`` considered.

    Parameters
    ----------
    observations, fit
        The fit and what it was made of; with the derivative of the reference where the clock is an unknown.
    duration_s : float
        Time that the samples cover, s.
    kind : {"fit", "clock", "full"}
        ``fit`` has these unknowns itself. ``clock`` was made at a clock that is one unknown more here, and stays the
        plain estimate. ``full``: all nine elements of T are unknown, and the plain estimate is where they lead.
    always : bool
        Move in one step whether unseen blocks bear it out or not, over a coarse grid of sizes: for a test.
    never : bool
        Stay at the plain estimate whatever unseen blocks say: its errors alone are asked for.
    known : Moments, optional
        The moments of the fit, where they have been taken already.
    """
    begun = rows_of(observations, fit, is_full=kind == "full")
    starts, blocks, folds = _edges(observations, fit)
    sizes = FEW_SIZES if always else SIZES
    about = LockedModel.at(begun, columns, known or begun.moments(columns.columns, starts), sizes)
    # What a fit leaves of its own step is no error: its minimum may be that of another residual.
    own_step = about.posterior.reduced.offset if kind == "fit" else np.zeros_like(about.posterior.reduced.offset)
    first = about.posterior.reduced.offset - own_step
    base = first if kind == "full" else np.zeros_like(first)
    ratios = np.ones(1) if always or never else held_out(about, folds, observations)
    moved = always or bool(np.all(ratios < 1.0) and np.median(ratios) < BETTER)
    end = first + about.posterior.mixture.step if moved else base
    for _ in range(_ROUNDS - 1 if moved and not always else 0):
        sigmas = [channel.sigma_nt for channel in begun.channels]
        rows = rows_of(observations, fit, sigmas_nt=sigmas, at=begun.moved(end), is_full=kind == "full")
        about = LockedModel.at(rows, columns, rows.moments(columns.columns, starts), SIZES)
        end = end + about.posterior.reduced.offset - own_step + about.posterior.mixture.step
    matrix, parameters = begun.moved(end)
    spread = about.posterior.mixture.covariance(None if moved else base - first)
    sun, unseen = about.posterior.unseen_sun()
    more = MOVE_ERROR**2 * np.outer(end - base, end - base) + unseen if not always else unseen
    own = begun.unknowns.to_parameters(matrix)
    in_parameters = own @ spread @ own.T
    softening = softening_of(about.rows, about.posterior.moments, fit)
    least = np.diag(fit.covariance) if len(own) == len(fit.covariance) else None
    widening = about.posterior.widening(own, np.diag(in_parameters), blocks, softening, duration_s, least)
    every = np.ones(len(spread))
    if kind == "full":
        q = np.eye(len(spread))
        every = about.posterior.widening(q, np.diag(spread), blocks, softening, duration_s)
    return LockedTerms(
        parameters=parameters,
        matrix=matrix,
        unknown_covariance=spread * np.outer(every, every) + more,
        covariance=in_parameters * np.outer(widening, widening) + own @ more @ own.T,
        widening=widening,
        families={} if always else about.records(),
        effective_share=about.posterior.share,
        moved=moved,
        held_out=ratios,
        unseen_sun_nt=sun * about.rows.channels[0].sigma_nt,
        plain=begun.moved(base)[1],
        step=end,
        columns=columns,
        moments=about.posterior.moments,
        softening=softening,
    )


def starts_of(fit: Fit, most: int) -> NDArray[np.intp]:
    """Return the first samples of at most so many blocks of the fit's own, neighbours together."""
    starts = fit.blocks.starts
    return starts if len(starts) <= most else starts[(np.arange(most) * len(starts)) // most]


def _edges(o: Observations, fit: Fit) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the first samples of fine blocks, and which of these begin the blocks of the scores and the folds."""
    scores = starts_of(fit, BLOCKS)
    folds = np.array([fold.start for fold in folds_of(o.t_s)], np.intp)
    starts = np.union1d(scores, folds)
    return starts, np.searchsorted(starts, scores), np.searchsorted(starts, folds)


def moved_fit(observations: Observations, fit: Fit, terms: LockedTerms) -> Fit:
    """Return ``fit`` where the estimate moved: its parameters and residuals; the fit itself where it did not."""
    if not terms.moved:
        return fit
    parameters = replace(terms.parameters, time_offset_s=fit.parameters.time_offset_s)
    residual = residuals_nt(observations, terms.parameters, is_vector=fit.residuals_nt.ndim == 2)
    return replace(fit, parameters=parameters, residuals_nt=residual)

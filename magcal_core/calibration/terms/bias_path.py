"""The path of the bias inside a session: posterior mean and error of a wandering bias, block by block, from moments.

It changes no parameter: it says what the bias did while the parameters hold one value for all of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Indices, Times
from magcal_core.calibration.terms.bias_steps import BiasStep, bias_steps
from magcal_core.calibration.terms.wandering_bias import (
    BIAS,
    MODELS,
    Blocks,
    KeptMoments,
    Process,
    Solved,
    Wander,
    solved,
)
from magcal_core.sensor.regressors import is_step, step_column
from magcal_core.units import utc_text

STILL_ODDS: Final = 0.75
"""Probability, before the data are seen, that the bias does not wander."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasPath:
    """The bias over a session.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (m,)
        Middle of each block, UTC.
    bias_nt, standard_errors_nt : shape (m, 3)
        With every regressor at zero, as the parameters have it.
    own_bias_nt, own_errors_nt : shape (3,)
        Of the fit that the moments are of: one value for the whole session; errors of white noise.
    steps : the steps that were found, which the path takes.
    """

    t_utc: Times
    bias_nt: Floats
    standard_errors_nt: Floats
    own_bias_nt: Floats
    own_errors_nt: Floats
    steps: tuple[BiasStep, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the path as the service answers it."""
        return {
            "time": [utc_text(time) for time in self.t_utc],
            "bias_nt": self.bias_nt.tolist(),
            "standard_errors_nt": self.standard_errors_nt.tolist(),
            "steps": [step.to_dict() for step in self.steps],
        }


def bias_path(moments: KeptMoments) -> BiasPath:
    """Return the path of the bias that the moments of a fit show.

    Notes
    -----
    Averaged over the noise models by likelihood and odds of three to one for none; the spread between them is in the
    errors. Each model's path is that of the fit's bias, the steps and the wandering bias together.
    """
    blocks, steps = Blocks.of(moments), bias_steps(moments).items
    places = [step.block for step in steps]
    found = [(model, solved(blocks, Process.of(blocks, model), places)) for model in MODELS]
    likelihood = np.array([one.log_likelihood for _, one in found])
    odds = np.array([STILL_ODDS, *np.full(len(MODELS) - 1, (1.0 - STILL_ODDS) / (len(MODELS) - 1))])
    weights = odds * np.exp(likelihood - likelihood.max())
    weights /= weights.sum()
    take = moments.unknowns(moments.fitted, has_clock=moments.is_clock_fitted)
    middle = moments.begins + (moments.ends - moments.begins) // 2
    to_bias, fitted_nt = _bias_of_blocks(moments, take, middle)
    paths = [_path(blocks, model, one, places, to_bias) for model, one in found]
    moved = np.array([path for path, _ in paths])
    mean = np.einsum("k,kmi->mi", weights, moved)
    variance = np.einsum("k,kmi->mi", weights, np.array([one for _, one in paths]) + (moved - mean) ** 2)
    own = moments.parameters(moments.own, moments.fitted).bias_nt
    still, at_end = found[0][1], to_bias[-1]
    of_fit = at_end @ still.inverse[: len(take), : len(take)] @ at_end.T * still.variance
    return BiasPath(middle, own + fitted_nt + mean, np.sqrt(variance), own, np.sqrt(np.diag(of_fit)), steps)


def _bias_of_blocks(moments: KeptMoments, take: Indices, middle: Times) -> tuple[Floats, Floats]:
    """Return the bias's derivative by the fit's unknowns in each block, (m, 3, q), and what fitted steps add, (m, 3).

    A fit with steps among its regressors has the bias after the last one; before them it was another.
    """
    jacobian = moments.to_parameters(moments.own)[:, take]
    slopes = moments.parameters(moments.own, moments.fitted).regressors
    to_bias = np.repeat(jacobian[None, 0:3], len(middle), axis=0)
    added = np.zeros((len(middle), 3))
    for name in filter(is_step, moments.fitted):
        column = step_column(name, middle)
        rows = jacobian[moments.unknowns((name,), has_clock=False)[9:]]
        to_bias = to_bias + column[:, None, None] * rows
        added += np.outer(column, slopes[name])
    return to_bias, added


def _path(blocks: Blocks, model: Wander, here: Solved, places: list[int], to_bias: Floats) -> tuple[Floats, Floats]:
    """Return how far the bias is from the fit's in each block and its variance, shape (m, 3) both, nT, nT^2."""
    m, q = len(blocks), blocks.scores.shape[1]
    of_bias = to_bias[-1][:, BIAS]
    others = np.zeros((m, 3, len(here.estimate)))
    others[:, :, :q] = to_bias
    for i, place in enumerate(places):
        others[:, :, q + 3 * i : q + 3 * i + 3] = blocks.after(place)[:, None, None] * of_bias
    moved = others @ here.estimate
    if model.deviation == 0.0:
        return moved, here.variance * np.einsum("mit,ts,mis->mi", others, here.inverse, others)
    moved = moved + here.bias.reshape(m, 3) @ of_bias.T
    # With u = -U c_u - carried^T x: what is uncertain of the other unknowns comes through both.
    carried = here.carried.reshape(len(here.estimate), m, 3).transpose(1, 2, 0)
    through = others - of_bias @ carried
    at = np.arange(m)
    own = here.bias_inverse.reshape(m, 3, m, 3)[at, :, at]
    variance = np.einsum("mit,ts,mis->mi", through, here.inverse, through, optimize=True)
    return moved, here.variance * (variance + np.einsum("ia,mab,ib->mi", of_bias, own, of_bias))

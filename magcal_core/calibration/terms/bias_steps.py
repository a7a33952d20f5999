"""Steps of the bias inside a session: named from the moments of a fit, with time, size and errors; nothing is removed.

Notes
-----
A step at the beginning of block j adds three columns to the unknowns (`wandering_bias`): S_j is the information of the
step after all else is projected out, s_j its score, D_j^2 = s^T (S + sigma^2 / (2000 nT)^2)^-1 s. The statistic is

    2 [max over noise models and j of log L(RSS - D_j^2) - max over noise models of log L(RSS)].

Its limit of 25 was passed by one of 896 simulated sessions without a step: white noise, memories of 5 to 90 min, waves,
drift; 1.5 to 12 h; |B| and components (`docs/time.md`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Indices
from magcal_core.calibration.terms.wandering_bias import (
    BIAS,
    DEVIATIONS,
    MODELS,
    STEP_PRIOR_NT,
    Blocks,
    KeptMoments,
    Process,
    Solved,
    log_likelihood,
    plain_log_likelihoods,
    solved,
    step_information,
)
from magcal_core.sensor.regressors import BEFORE
from magcal_core.units import utc_text

LIMIT: Final = 25.0
MOST_STEPS: Final = 2
_APART: Final = 3
_EDGE: Final = 0.08
_WORST_ERROR_NT: Final = 500.0
_AS_LIKELY: Final = 3.0
"""Loss of log L up to which another place is as good a time of the step."""
_NOTHING: Final = 16.0
"""Statistic under noise alone below which there is no step where no wander shows either."""
_BETTER: Final = 1.0
"""Gain of log L from which on a wandering bias shows."""
_FEW_BLOCKS: Final = 24
_COARSE: Final = tuple(one for one in MODELS[1:] if one.deviation in DEVIATIONS[1::2])
_FEWEST_BLOCKS: Final = 12
"""With fewer there is no place far enough from both ends with blocks to leave out about it."""


@dataclass(frozen=True, slots=True, eq=False)
class BiasStep:
    """One step of the bias.

    Attributes
    ----------
    time, begin, end : UTC; of the step, and of the places that are as likely.
    change_nt, standard_errors_nt : shape (3,)
        After less before, of the reported bias.
    covariance_nt2 : shape (3, 3)
    block : first block after it.
    """

    time: np.datetime64
    begin: np.datetime64
    end: np.datetime64
    change_nt: Floats
    covariance_nt2: Floats
    statistic: float
    block: int

    @property
    def standard_errors_nt(self) -> Floats:
        """Standard error of each component, shape (3,), nT."""
        return np.asarray(np.sqrt(np.diag(self.covariance_nt2)))

    @property
    def column(self) -> str:
        """Name of the regressor that takes it up."""
        return BEFORE + utc_text(self.time)

    @property
    def text(self) -> str:
        """The step in words."""
        size = float(np.linalg.norm(self.change_nt))
        told = ", ".join(f"{c:+.0f} +- {e:.0f}" for c, e in zip(self.change_nt, self.standard_errors_nt, strict=True))
        return f"the bias changed by {told} nT ({size:.0f} in all) at {utc_text(self.time)[:19]}Z"

    def to_dict(self) -> dict[str, object]:
        """Return the step as records have it."""
        return {
            "time": utc_text(self.time),
            "from": utc_text(self.begin),
            "until": utc_text(self.end),
            "change_nt": self.change_nt.tolist(),
            "standard_errors_nt": self.standard_errors_nt.tolist(),
            "statistic": self.statistic,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True, eq=False)
class BiasSteps:
    """The search for steps.

    Attributes
    ----------
    state : ``searched``, or ``not_searched`` where the data hardly determine the fit, or it leaves no blocks.
    searched_share : share of the blocks at whose beginning a step would have shown.
    statistic : of the last place that was looked at: of the first that is not believed.
    items : in the order of time.
    is_fitted : whether the parameters are those of a fit with the steps as unknowns.
    """

    state: str
    searched_share: float
    statistic: float | None
    items: tuple[BiasStep, ...]
    is_fitted: bool = False

    def to_dict(self) -> dict[str, object]:
        """Return the search as records have it."""
        return {
            "state": self.state,
            "searched_share": self.searched_share,
            "statistic": self.statistic,
            "limit": LIMIT,
            "is_fitted": self.is_fitted,
            "items": [one.to_dict() for one in self.items],
        }


NOT_SEARCHED: Final = BiasSteps("not_searched", 0.0, None, ())


def bias_steps(moments: KeptMoments, *, has_drift: bool = False) -> BiasSteps:
    """Return the steps of the bias that the moments of a fit show.

    ``has_drift``: the bias is known to drift, so that steps are looked for beside a line in time: of passes that are
    hours apart, one would do for it.
    """
    blocks = Blocks.of(moments)
    if has_drift:
        blocks = blocks.beside_a_line()
    if len(blocks) < _FEWEST_BLOCKS or blocks.freedom < 1.0:
        return NOT_SEARCHED
    still = _search(blocks, [Process.of(blocks, MODELS[0])], ())
    if still.statistic < _NOTHING and not _wanders(blocks):
        return BiasSteps("searched", still.share, max(still.statistic, 0.0), ())
    processes = [Process.of(blocks, model) for model in MODELS]
    known: list[tuple[int, float, tuple[int, int]]] = []
    share, statistic = 0.0, 0.0
    while True:
        beside = [block for block, _, _ in known]
        found = _search(blocks, processes, beside)
        if known and found.statistic > LIMIT:
            found = _search_apart(blocks, beside)
        share = found.share if not known else share
        statistic = max(found.statistic, 0.0)
        if statistic <= LIMIT:
            break
        known.append((found.place, statistic, found.span))
        if len(known) == MOST_STEPS:
            break
    known.sort()
    places = [block for block, _, _ in known]
    sizes = step_sizes(moments, blocks, places) if places else []
    items = tuple(
        BiasStep(
            moments.begins[block], moments.begins[span[0]], moments.begins[span[1]], *size, statistic=value, block=block
        )
        for (block, value, span), size in zip(known, sizes, strict=True)
    )
    return BiasSteps("searched", share, statistic, items)


@dataclass(frozen=True, slots=True)
class _Found:
    """The best place of one search, those as likely, and the share of the blocks that were looked at."""

    place: int
    statistic: float
    span: tuple[int, int]
    share: float


def _search(blocks: Blocks, processes: Sequence[Process], known: Sequence[int]) -> _Found:
    """Return the best place of a step beside those that are ``known``; that without wander comes first."""
    places = _places(blocks, known)
    if not len(places):
        return _Found(0, 0.0, (0, 0), 0.0)
    plain = np.full(len(places), np.nan)
    highest, best, share_at = np.full(len(places), -np.inf), -np.inf, (-np.inf, 0.0)
    for process in processes:
        here = solved(blocks, process, known)
        gain, error = _gains(blocks, here, places, known)
        if process.model.deviation == 0.0:
            plain = error
        counts = (error < _WORST_ERROR_NT) & (plain < _WORST_ERROR_NT)
        likelihood = log_likelihood(here.rss - gain, blocks.freedom, here.log_determinant)
        highest = np.maximum(highest, np.where(counts, likelihood, -np.inf))
        best = max(best, here.log_likelihood)
        share_at = max(share_at, (here.log_likelihood, float(counts.sum()) / len(blocks)))
    if not np.isfinite(highest).any():
        return _Found(0, 0.0, (0, 0), 0.0)
    top = int(np.argmax(highest))
    near = places[highest > highest[top] - _AS_LIKELY]
    return _Found(int(places[top]), 2.0 * float(highest[top] - best), (int(near[0]), int(near[-1])), share_at[1])


def _search_apart(blocks: Blocks, known: Sequence[int]) -> _Found:
    """Return the best place of a step beside those that are ``known``, without the two blocks about each of these.

    A step within a block leaves that block with a mean that is neither the bias before nor the one after it, which in
    quiet readings looks like a second step close by.
    """
    rest = blocks.without(_about(known))
    return _search(rest, [Process.of(rest, model) for model in MODELS], known)


def _about(places: Sequence[int]) -> list[int]:
    """Return the two blocks about each of ``places``."""
    return [block for place in places for block in (place - 1, place)]


def _wanders(blocks: Blocks) -> bool:
    """Return whether a wandering bias explains the session better than noise alone, seen in few blocks.

    A step that would be believed looks like one: where none does, every noise model need not be searched.
    """
    few = blocks.together(max(1, len(blocks) // _FEW_BLOCKS))
    likelihood = plain_log_likelihoods(few, (MODELS[0], *_COARSE))
    return bool(likelihood.max() > likelihood[0] + _BETTER)


def _places(blocks: Blocks, known: Sequence[int]) -> Indices:
    """Return the blocks at whose beginning a step may be: not near an end, nor near one that is known."""
    edge = max(1, int(np.ceil(_EDGE * len(blocks))))
    places = np.arange(edge, len(blocks) - edge + 1)
    for one in known:
        places = places[np.abs(places - one) >= _APART]
    return places


def _gains(blocks: Blocks, here: Solved, places: Indices, known: Sequence[int]) -> tuple[Floats, Floats]:
    """Return D^2, nT^2, and the worst standard error, nT, of a step at each of ``places``."""
    information, score = step_information(blocks, known, here, places)
    held = information + here.variance / STEP_PRIOR_NT**2 * np.eye(3)
    gain = np.einsum("pc,pc->p", score, np.linalg.solve(held, score[:, :, None])[:, :, 0])
    least = np.linalg.eigvalsh(information)[:, 0]
    error = np.sqrt(here.variance / np.maximum(least, 1e-300))
    return np.clip(gain, 0.0, here.rss * (1.0 - 1e-12)), error


def step_sizes(moments: KeptMoments, blocks: Blocks, places: Sequence[int]) -> list[tuple[Floats, Floats]]:
    """Return change, nT, and covariance, nT^2, of the reported bias at each of ``places``.

    The two blocks about each step are left out: when in them it happened is not known. Averaged over the noise models
    by likelihood, the spread between them in the covariance.
    """
    rest = blocks.without(_about(places))
    found = [solved(rest, Process.of(rest, model), places) for model in MODELS]
    weights = np.exp(np.array([one.log_likelihood for one in found]) - max(one.log_likelihood for one in found))
    weights /= weights.sum()
    of = found[0].steps(blocks.scores.shape[1])
    estimates = np.array([one.estimate[of] for one in found])
    mean = weights @ estimates
    away = estimates - mean
    covariance = sum(w * one.variance * one.inverse[of, of] for w, one in zip(weights, found, strict=True))
    covariance = np.asarray(covariance) + np.einsum("k,ki,kj->ij", weights, away, away)
    to_bias = moments.to_parameters(moments.own)[0:3, BIAS]
    return [
        (
            to_bias @ mean[3 * i : 3 * i + 3],
            to_bias @ covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] @ to_bias.T,
        )
        for i in range(len(places))
    ]

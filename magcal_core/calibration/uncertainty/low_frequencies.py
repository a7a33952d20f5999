"""Variances of the parameters from the lowest frequencies of their scores: errors under a memory of any length.

Notes
-----
The error of an estimate is the sum of its scores, that is, their content at frequency zero, which the fit itself sets
to zero in the data. It has to be carried over from the lowest frequencies that remain. Blocks cannot do so where the
memory of the errors is a good part of the session: too few are independent. Here the scores' cosine transform c_k,
k = 1..K, in units of what white noise would give after the same fit, is set beside first-order processes of several
memories and sizes,

    c_k^2 ~ s^2 (1 + a d_k(tau)),    variance of the sum = s^2 (1 + a z(tau)),

with d_k and z of exp(-|t|/tau). Every (tau, a) is weighed by how well it explains the c_k. White noise has three to one
beforehand, every other one an equal share of the rest; and the parameters share these odds: where most of them look
white, so most probably is the one that is in doubt. The standard error is that 1.96 of it hold 95 % of the mixture of
the normal laws that remain. So one long wave that shows widens the interval, and so does, by less, the one that so
short a session could not have shown. Memories are times, not shares of the session: what moves a bias (heat, currents,
the orbit) remembers minutes to hours, whatever the length of the data. Longer ones count as far as the session shows
them: an error with the period of the orbit beats slowly with what the parameters do over an orbit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import NotObservableError
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import is_positive_definite, scaled_inverse
from magcal_core.numerics.tails import deviations_of_mixtures

MEMORIES_S: Final = tuple(120.0 * 2.0**i for i in range(12))
"""Correlation times that are tried, s: 2 minutes to 2.8 days."""
UNSEEN_S: Final = 16000.0
"""Correlation time, s, up to which one is tried that is longer than the session."""
MOST_SESSIONS: Final = 6.0
"""Longest correlation time that is tried, in lengths of the session: of a longer one nothing shows but its start."""
SIZES: Final = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Variances of the process that are tried, in units of that of a block's white noise."""
WHITE_ODDS: Final = 0.75
"""Probability, before the data are seen, that the scores are white."""
ODDS_STRENGTH: Final = 4.0
"""In how many parameters' place that probability stands when all of them tell theirs."""
MERGED_BLOCKS: Final = 64
"""To how many blocks those of a session are put together."""
_FREQUENCIES: Final = 40
_LEAST_SHARE: Final = 0.1
"""Least share of a frequency's white noise that the fit is taken to leave: what it took up is not known better."""
_SHORTEST_BLOCKS: Final = 0.5
"""Shortest correlation time that is tried, in blocks: a shorter one is white to the blocks."""
_ROUNDS: Final = 5
_HALVINGS: Final = 9
"""How often the bracket of a standard error is halved, from at most a factor of 1e3; the rest is interpolated."""
_LEAST_DEVIATION: Final = 1e-150
_STEPS_AN_OCTAVE: Final = 8
"""To how much a memory's share of the session is rounded, so that sessions of about the same length share a table."""


def low_frequency_variances(scores: BlockScores, duration_s: float) -> tuple[Floats, int]:
    """Return the variance of each reported parameter, shape (p,), and the number of frequencies it was taken from.

    ``duration_s``: time that the blocks cover, s.

    Raises
    ------
    NotObservableError
        The normal matrix is not positive definite, or so near to singular that variances come out negative.
    """
    sums, normals = _merged(scores)
    if not is_positive_definite(normals.sum(axis=0)):
        raise NotObservableError(
            "the samples do not determine the parameters: their normal matrix is not positive definite"
        )
    processes = processes_of(len(sums), duration_s)
    total = normals.sum(axis=0)
    inverse = scaled_inverse(total)
    to_parameters = scores.to_parameters @ inverse
    power = (processes.cosines.T @ sums @ to_parameters.T) ** 2
    excess = power / _white(processes.cosines, normals, inverse, to_parameters)
    factor = processes.widening(excess)
    return factor * np.einsum("pa,ab,pb->p", to_parameters, total, to_parameters), processes.cosines.shape[1]


@dataclass(frozen=True, slots=True, eq=False)
class Processes:
    """White noise and every memory and size that scores of m blocks are set beside.

    Attributes
    ----------
    cosines : shape (m, k)
        Of the frequencies, by block.
    shapes, sizes : shape (g, k), (g,)
        1 + a d_k, and 1 + a z.
    logarithms : shape (g, 1)
        Sums of the logarithms of ``shapes``.
    """

    cosines: Floats
    shapes: Floats
    sizes: Floats
    logarithms: Floats

    def widening(self, excess: Floats) -> Floats:
        """Return variances over those of white noise, shape (p,), where the scores have ``excess``, shape (k, p).

        Raises
        ------
        NotObservableError
            Rounding has made some of it negative.
        """
        count = self.cosines.shape[1]
        rest = (1.0 / self.shapes) @ excess
        if (rest < 0.0).any():
            raise NotObservableError(
                "the samples do not determine the parameters: rounding makes their variances negative"
            )
        likelihood = -0.5 * self.logarithms - 0.5 * count * np.log(np.maximum(rest, 1e-300))
        weights = _weights(np.exp(likelihood - likelihood.max(axis=0)))
        deviations = np.maximum(np.sqrt(rest * self.sizes[:, None] / count), _LEAST_DEVIATION)
        return deviations_of_mixtures(weights, deviations, _HALVINGS) ** 2


def processes_of(m: int, duration_s: float) -> Processes:
    """Return the processes that ``m`` blocks over ``duration_s`` are set beside."""
    return Processes(*_processes(m, min(m - 1, _FREQUENCIES), _memories(duration_s, m)))


def left_by_fit(own: Floats, taken: Floats) -> Floats:
    """Return the power that white noise has after the fit, of what it has before and what the fit took up."""
    return np.asarray(np.maximum(own - taken, _LEAST_SHARE * own + 1e-300))


def longest_memory_s(duration_s: float) -> float:
    """Return the longest correlation time, s, that a session of ``duration_s`` is held against."""
    return min(max(duration_s, min(MOST_SESSIONS * duration_s, UNSEEN_S)), MEMORIES_S[-1])


def _memories(duration_s: float, m: int) -> tuple[float, ...]:
    """Return the correlation times that ``m`` blocks over ``duration_s`` can tell from white noise, in sessions."""
    length_s = max(duration_s, 1e-9)
    longest_s = longest_memory_s(length_s)
    octaves = (np.log2(memory_s / length_s) for memory_s in MEMORIES_S if memory_s <= longest_s)
    shares = (float(2.0 ** (round(_STEPS_AN_OCTAVE * octave) / _STEPS_AN_OCTAVE)) for octave in octaves)
    return tuple(share for share in shares if share >= _SHORTEST_BLOCKS / m)


def _weights(likelihood: Floats) -> Floats:
    """Return the probability of every process, shape (g, p), from its likelihood, white noise first.

    The odds of white noise are those of all parameters together: each counts with its own probability.
    """
    others, parameters = max(len(likelihood) - 1, 1), likelihood.shape[1]
    white = WHITE_ODDS
    for _ in range(_ROUNDS):
        odds = np.full(len(likelihood), (1.0 - white) / others)
        odds[0] = white
        weights = odds[:, None] * likelihood
        weights /= weights.sum(axis=0)
        white = float(ODDS_STRENGTH * WHITE_ODDS + weights[0].sum()) / (ODDS_STRENGTH + parameters)
    return np.asarray(weights)


def _merged(scores: BlockScores) -> tuple[Floats, Floats]:
    """Return the sums of scores and normal matrices over at most `MERGED_BLOCKS` blocks."""
    count = len(scores.starts)
    if count <= MERGED_BLOCKS:
        return scores.scores, scores.normals
    edges = (np.arange(MERGED_BLOCKS) * count) // MERGED_BLOCKS
    return np.add.reduceat(scores.scores, edges, axis=0), np.add.reduceat(scores.normals, edges, axis=0)


def _white(cosines: Floats, normals: Floats, inverse: Floats, to_parameters: Floats) -> Floats:
    """Return the power that white noise of unit variance has after the fit, shape (k, p): what the fit took up is off.

    The scores s_i - N_i I^-1 sum(s) have the covariance N_i delta_ij - N_i I^-1 N_j.
    """
    m, q, _ = normals.shape
    flat = normals.reshape(m, q * q)
    before = ((cosines**2).T @ flat).reshape(-1, q, q)
    shared = (cosines.T @ flat).reshape(-1, q, q)
    own = np.sum((to_parameters @ before) * to_parameters, axis=2)
    taken = np.sum((to_parameters @ (shared @ inverse @ shared)) * to_parameters, axis=2)
    return left_by_fit(own, taken)


@lru_cache(maxsize=64)
def _processes(m: int, count: int, memories: tuple[float, ...]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return cosines, shape (m, k); 1 + a d_k, (g, k), and 1 + a z, (g,), of white noise and every memory and size.

    ``memories``: in sessions. The last are the sums of the logarithms of 1 + a d_k, shape (g, 1).
    """
    cosines = np.sqrt(2.0 / m) * np.cos(np.pi * np.outer(np.arange(m) + 0.5, np.arange(1, count + 1)) / m)
    lags = np.arange(m)
    apart = np.abs(lags[:, None] - lags)
    shapes, sizes = [np.ones(count)], [1.0]
    for memory in memories:
        correlation = np.exp(-lags / (m * memory))[apart]
        at_frequency = np.sum(cosines * (correlation @ cosines), axis=0)
        at_zero = float(correlation.sum()) / m
        shapes += [1.0 + size * at_frequency for size in SIZES]
        sizes += [1.0 + size * at_zero for size in SIZES]
    made = np.array(shapes)
    return cosines, made, np.array(sizes), np.log(made).sum(axis=1)[:, None]

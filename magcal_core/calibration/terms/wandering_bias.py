"""A bias that wanders beside the unknowns of a fit, from its blocks: which noise models there are, and what each says.

Notes
-----
Each block b of a fit kept N_b = J^T W J, g_b = J^T W r and its cost. Beside the fit's unknowns stands a bias u_b of
each block, an Ornstein-Uhlenbeck process of memory tau whose deviation is rho times the noise of a sample, in the
fit's own unknowns 6 to 8. With A the normal matrix of all unknowns and c their scores,

    RSS = cost - c^T A^-1 c,    log L = -(n - q) / 2 log(RSS / (n - q)) - log(det A / det P) / 2,

P the process's own precision. Steps found so far are unknowns too, held by a prior of 2,000 nT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np

from magcal_core.arrays import Floats, Indices, Times
from magcal_core.numerics.bands import band_factor, band_solution
from magcal_core.numerics.linear_algebra import unit_diagonal
from magcal_core.sensor.parameters import Parameters

MEMORIES_S: Final = (300.0, 900.0, 2700.0, 8100.0, 32400.0)
DEVIATIONS: Final = tuple(float(x) for x in np.geomspace(0.02, 8.0, 7))
"""Deviation of the wandering bias over the noise of a sample."""
STEP_PRIOR_NT: Final = 2000.0
BIAS: Final = slice(6, 9)
"""Where the bias stands among the fit's own unknowns."""


@dataclass(frozen=True, slots=True)
class Wander:
    """A noise model: memory, s, and deviation of the bias over the noise of a sample; none where that is 0."""

    memory_s: float
    deviation: float


MODELS: Final = (Wander(0.0, 0.0), *(Wander(memory, size) for memory in MEMORIES_S for size in DEVIATIONS))


class KeptSums(Protocol):
    """Sums over the blocks of a fit, as its moments have them."""

    @property
    def normals(self) -> Floats:
        """J^T W J, shape (m, q, q)."""
        ...

    @property
    def scores(self) -> Floats:
        """J^T W r, shape (m, q)."""
        ...

    @property
    def costs(self) -> Floats:
        """r^T W r, shape (m,), nT^2."""
        ...

    @property
    def weights(self) -> Floats:
        """Weight of the residuals, shape (m,)."""
        ...


class KeptMoments(Protocol):
    """The moments of a fit (`FitMoments`), as far as a bias that moves needs them."""

    @property
    def sums(self) -> KeptSums:
        """Sums over the blocks."""
        ...

    @property
    def begins(self) -> Times:
        """First sample of each block, UTC, shape (m,)."""
        ...

    @property
    def ends(self) -> Times:
        """Last sample of each block, UTC, shape (m,)."""
        ...

    @property
    def own(self) -> Floats:
        """The fit's own unknowns."""
        ...

    @property
    def fitted(self) -> tuple[str, ...]:
        """Regressors that the fit has."""
        ...

    @property
    def is_clock_fitted(self) -> bool:
        """Whether the clock's offset was an unknown."""
        ...

    def unknowns(self, names: Sequence[str], *, has_clock: bool) -> Indices:
        """Return where the unknowns of a model with the regressors ``names`` stand."""
        ...

    def parameters(self, own: Floats, names: Sequence[str]) -> Parameters:
        """Return the reported parameters at the unknowns ``own``."""
        ...

    def to_parameters(self, own: Floats) -> Floats:
        """Return the derivative of the reported parameters by the unknowns."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """The blocks of a fit with its unknowns alone.

    Attributes
    ----------
    normals, scores : shape (m, q, q), (m, q)
    cost : nT^2.
    samples : weight of all residuals: how many they are worth.
    middle_s : shape (m,)
        Middle of each block, s from the first.
    """

    normals: Floats
    scores: Floats
    costs: Floats
    weights: Floats
    middle_s: Floats

    @classmethod
    def of(cls, moments: KeptMoments) -> Blocks:
        """Return the blocks of the moments with the unknowns that the fit had."""
        take = moments.unknowns(moments.fitted, has_clock=moments.is_clock_fitted)
        sums, begins = moments.sums, moments.begins
        middle = (begins - begins[0] + (moments.ends - begins) // 2) / np.timedelta64(1, "ns") * 1e-9
        return cls(sums.normals[:, take[:, None], take], sums.scores[:, take], sums.costs, sums.weights, middle)

    def __len__(self) -> int:
        return len(self.costs)

    def together(self, count: int) -> Blocks:
        """Return blocks of ``count`` neighbours each."""
        firsts = np.arange(0, len(self), count)
        middles = np.add.reduceat(self.middle_s, firsts) / np.diff([*firsts, len(self)])
        return Blocks(
            np.add.reduceat(self.normals, firsts, axis=0),
            np.add.reduceat(self.scores, firsts, axis=0),
            np.add.reduceat(self.costs, firsts),
            np.add.reduceat(self.weights, firsts),
            middles,
        )

    def without(self, left_out: Sequence[int]) -> Blocks:
        """Return the blocks with some of them empty."""
        kept = np.ones(len(self))
        kept[list(left_out)] = 0.0
        return Blocks(
            self.normals * kept[:, None, None],
            self.scores * kept[:, None],
            self.costs * kept,
            self.weights * kept,
            self.middle_s,
        )

    def beside_a_line(self) -> Blocks:
        """Return the blocks with a line in time of the bias, three unknowns more behind those of the fit."""
        at = 2.0 * (self.middle_s - self.middle_s.mean()) / max(float(np.ptp(self.middle_s)), 1e-9)
        carry = np.zeros((len(self), self.scores.shape[1], 3))
        carry[:, BIAS] = at[:, None, None] * np.eye(3)
        shared = self.normals @ carry
        across = carry.swapaxes(1, 2)
        normals = np.block([[self.normals, shared], [shared.swapaxes(1, 2), across @ shared]])
        scores = np.concatenate([self.scores, np.einsum("bcq,bq->bc", across, self.scores)], axis=1)
        return replace(self, normals=normals, scores=scores)

    @property
    def freedom(self) -> float:
        """Residuals, by weight, that the fit's unknowns leave free."""
        return float(self.weights.sum()) - float(self.scores.shape[1])

    def after(self, place: int) -> Floats:
        """Return 1 for the blocks from ``place`` on, 0 before, shape (m,)."""
        return (np.arange(len(self)) >= place).astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """All unknowns under one noise model: t of the fit and of the steps, and the wandering bias of m blocks.

    The bias is eliminated: its own matrix is banded, so that all of it costs what t unknowns and a few products do.

    Attributes
    ----------
    inverse : shape (t, t)
        Of A; times ``variance`` it is the covariance of the fit's unknowns and the steps.
    estimate : shape (t,)
    bias_inverse : shape (3m, 3m)
        Inverse of the bias's own part of A; empty where there is no wander.
    carried : shape (t, 3m)
        What the other unknowns share with the bias, times ``bias_inverse``.
    bias : shape (3m,)
        Estimate of the bias of each block.
    rss, log_likelihood, log_determinant : nT^2; of the model; of A over P.
    variance : nT^2, of a residual.
    """

    inverse: Floats
    estimate: Floats
    bias_inverse: Floats
    carried: Floats
    bias: Floats
    rss: float
    log_likelihood: float
    log_determinant: float
    variance: float

    def steps(self, fit: int) -> slice:
        """Return where the steps stand behind ``fit`` unknowns of the fit."""
        return slice(fit, len(self.estimate))


def log_likelihood(rss: Floats | float, freedom: float, log_determinant: Floats | float) -> Floats:
    """Return log L of a residual sum of squares."""
    return np.asarray(-0.5 * freedom * np.log(np.maximum(rss, 1e-300) / freedom) - 0.5 * log_determinant)


@dataclass(frozen=True, slots=True, eq=False)
class Process:
    """A noise model at the blocks of a fit: inverse of the bias's own part of A, and log(det of that part / det P)."""

    model: Wander
    inverse: Floats
    log_determinant: float

    @classmethod
    def of(cls, blocks: Blocks, model: Wander) -> Process:
        """Return the model at ``blocks``."""
        if model.deviation == 0.0:
            return cls(model, np.zeros((0, 0)), 0.0)
        return cls(model, *_bias_inverse(blocks, model))


def solved(blocks: Blocks, process: Process, steps: Sequence[int]) -> Solved:
    """Return the solution under a noise model with steps of the bias at the beginnings of the blocks ``steps``."""
    normal, score = _system(blocks, steps)
    bias_score = blocks.scores[:, BIAS].ravel()
    bias_inverse, log_determinant = process.inverse, process.log_determinant
    if len(bias_inverse):
        shared = _shared(blocks, steps)
        carried = shared @ bias_inverse
        normal = normal - carried @ shared.T
        reduced = score - carried @ bias_score
    else:
        carried, bias_score, reduced = np.zeros((len(score), 0)), bias_score[:0], score
    scaled, size = unit_diagonal(normal)
    factor = np.linalg.cholesky(scaled)
    half = np.linalg.inv(factor) / size
    inverse = half.T @ half
    log_determinant += 2.0 * float(np.log(np.diag(factor)).sum() + np.log(size).sum())
    estimate = -inverse @ reduced
    bias = -bias_inverse @ bias_score - carried.T @ estimate
    rss = max(float(blocks.costs.sum() + score @ estimate + bias_score @ bias), 1e-300)
    likelihood = float(log_likelihood(rss, blocks.freedom, log_determinant))
    variance = rss / blocks.freedom
    return Solved(inverse, estimate, bias_inverse, carried, bias, rss, likelihood, log_determinant, variance)


def _system(blocks: Blocks, steps: Sequence[int]) -> tuple[Floats, Floats]:
    """Return the normal matrix of the fit's unknowns and the steps, shape (t, t), and their scores, shape (t,)."""
    q, k = blocks.scores.shape[1], len(steps)
    normal, score = np.zeros((q + 3 * k, q + 3 * k)), np.zeros(q + 3 * k)
    normal[:q, :q], score[:q] = blocks.normals.sum(axis=0), blocks.scores.sum(axis=0)
    prior = float(blocks.costs.sum()) / blocks.freedom / STEP_PRIOR_NT**2
    for i, step in enumerate(steps):
        of, after = slice(q + 3 * i, q + 3 * i + 3), blocks.after(step)
        shared = np.einsum("b,bqc->qc", after, blocks.normals[:, :, BIAS])
        normal[:q, of], normal[of, :q] = shared, shared.T
        score[of] = after @ blocks.scores[:, BIAS]
        for j, other in enumerate(steps):
            both = np.einsum("b,bac->ac", after * blocks.after(other), blocks.normals[:, BIAS, BIAS])
            normal[of, q + 3 * j : q + 3 * j + 3] = both + (prior * np.eye(3) if i == j else 0.0)
    return normal, score


def _shared(blocks: Blocks, steps: Sequence[int]) -> Floats:
    """Return what the fit's unknowns and the steps share with the bias of each block, shape (t, 3m)."""
    parts = [blocks.normals[:, :, BIAS]]
    parts += [blocks.after(one)[:, None, None] * blocks.normals[:, BIAS, BIAS] for one in steps]
    joined = np.concatenate(parts, axis=1)
    return np.ascontiguousarray(joined.transpose(1, 0, 2)).reshape(joined.shape[1], -1)


def plain_log_likelihoods(blocks: Blocks, models: Sequence[Wander]) -> Floats:
    """Return log L of each noise model without any step, shape (len(models),): that of `solved`.

    No inverse of the bias's own part is made, and what no model changes is summed once.
    """
    normal, score = _system(blocks, ())
    shared, bias_score, own = _shared(blocks, ()), blocks.scores[:, BIAS].ravel(), _own_band(blocks)
    right = np.column_stack([shared.T, bias_score])
    count, t = len(models), len(score)
    taken, rss, log_determinant = (
        np.zeros((count, t, t + 1)),
        np.full(count, float(blocks.costs.sum())),
        np.zeros(count),
    )
    for k, model in enumerate(models):
        if model.deviation > 0.0:
            factor, log_determinant[k] = _bias_factor(own, blocks.middle_s, model)
            solution = band_solution(factor, right)
            taken[k] = shared @ solution
            rss[k] -= bias_score @ solution[:, -1]
    normals, scores = normal - taken[:, :, :-1], score - taken[:, :, -1]
    size = np.sqrt(np.diagonal(normals, axis1=1, axis2=2))
    factors = np.linalg.cholesky(normals / (size[:, :, None] * size[:, None, :]))
    halves = np.linalg.solve(factors, (scores / size)[:, :, None])[:, :, 0]
    log_determinant += 2.0 * (np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1) + np.log(size).sum(axis=1))
    left = np.maximum(rss - np.einsum("kt,kt->k", halves, halves), 1e-300)
    return log_likelihood(left, blocks.freedom, log_determinant)


def _bias_inverse(blocks: Blocks, model: Wander) -> tuple[Floats, float]:
    """Return the inverse of the bias's own part of A, shape (3m, 3m), and log(det of it / det P)."""
    factor, log_determinant = _bias_factor(_own_band(blocks), blocks.middle_s, model)
    return band_solution(factor, np.eye(factor.shape[1])), log_determinant


def _own_band(blocks: Blocks) -> Floats:
    """Return what the blocks say of the bias of each, shape (4, m, 3): lower diagonals, the process not in them."""
    own = blocks.normals[:, BIAS, BIAS]
    band = np.zeros((4, len(blocks), 3))
    band[0] = np.diagonal(own, axis1=1, axis2=2)
    band[1, :, :2] = own[:, [1, 2], [0, 1]]
    band[2, :, 0] = own[:, 2, 0]
    return band


def _bias_factor(own: Floats, middle_s: Floats, model: Wander) -> tuple[Floats, float]:
    """Return the Cholesky factor of the bias's own part of A, shape (4, 3m) for its diagonals, and log(det / det P).

    ``own``: of `_own_band`; ``middle_s``: times of the blocks, shape (m,).

    Notes
    -----
    The process is Markov: its precision is tridiagonal in the blocks, so that the whole is a band of four diagonals.
    """
    m, weight = len(middle_s), 1.0 / model.deviation**2
    kept = np.exp(-np.diff(middle_s) / model.memory_s)
    lost = np.maximum(1.0 - kept**2, 1e-12)
    diagonal = np.ones(m)
    diagonal[1:] = 1.0 / lost
    diagonal[:-1] += kept**2 / lost
    band = own.copy()
    band[0] += weight * diagonal[:, None]
    band[3, :-1] = -weight * (kept / lost)[:, None]
    factor = band_factor(band.reshape(4, 3 * m))
    log_prior = m * np.log(weight) - np.log(lost).sum()
    return factor, float(2.0 * np.log(factor[0]).sum() - 3.0 * log_prior)


def step_information(blocks: Blocks, steps: Sequence[int], here: Solved, places: Indices) -> tuple[Floats, Floats]:
    """Return S, shape (p, 3, 3), and s, shape (p, 3), of a step at each of ``places``, all else projected out.

    Notes
    -----
    The columns of a step are 1 from its block on and 0 before it: every sum over them is a running sum from the end.
    """
    m, own = len(blocks), blocks.normals[:, BIAS, BIAS]
    information = _from_the_end(own)[places]
    score = _from_the_end(blocks.scores[:, BIAS])[places]
    joined = _shared(blocks, steps).reshape(len(here.estimate), m, 3).transpose(1, 0, 2)
    shared = _from_the_end(joined)
    if len(here.bias):
        weighed = np.matmul(own, here.bias_inverse.reshape(m, 3, 3 * m)).reshape(3 * m, m, 3)
        weighed = np.matmul(weighed.transpose(1, 0, 2), own)
        summed = _from_the_end(weighed).reshape(m, m, 3, 3).transpose(1, 0, 2, 3)
        information = information - _from_the_end(summed)[places, places]
        carried = here.carried.reshape(len(here.estimate), m, 3).transpose(1, 0, 2)
        shared = shared - _from_the_end(np.matmul(carried, own))
        score = score + _from_the_end(np.einsum("bac,bc->ba", own, _alone(blocks, here)))[places]
    shared = shared[places]
    information = information - np.matmul(shared.transpose(0, 2, 1), np.matmul(here.inverse, shared))
    score = score + np.einsum("pta,t->pa", shared, here.estimate)
    return 0.5 * (information + information.transpose(0, 2, 1)), score


def _alone(blocks: Blocks, here: Solved) -> Floats:
    """Return the bias of each block where nothing else moves, shape (m, 3)."""
    return (-here.bias_inverse @ blocks.scores[:, BIAS].ravel()).reshape(len(blocks), 3)


def _from_the_end(values: Floats) -> Floats:
    """Return the running sums over the first axis from its end."""
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1])

"""Evidence for terms with an a-priori size: posterior of the parameters over a grid of sizes, from moments alone.

Notes
-----
y = J d + F a + noise over the residual's standard deviation, d flat, a_f ~ N(0, g_f^2) for each family f. With

    M = F'F - F'J (J'J)^-1 J'F,    v = F'y - F'J (J'J)^-1 J'y,    D = diag(g^2),    A = D^-1 + k M,

the mean of a is a(g) = A^-1 k v and, the noise's size unknown with nu degrees of freedom,

    log p(g) = sum_f log prior(g_f) - 1/2 log|I + D^1/2 kM D^1/2| - nu k/2 log(S - v'a(g)),
    S = y'y - y'J (J'J)^-1 J'y.

k <= 1 is the effective share of rows that remember their neighbours. All combinations of sizes are factorised at once:
the Cholesky factor of the matrix bordered by kv, with k S in the corner, holds A's determinant, and what is left.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.observability.information import PARAMETER_NAMES
from magcal_core.errors import NotObservableError
from magcal_core.numerics.linear_algebra import is_positive_definite, scaled_inverse

SIZES: Final = (0.0, 0.1, 0.3, 1.0, 3.0)
"""Sizes of a family, root mean square, that are tried, in standard deviations of the residual."""
NO_SIZES: Final[Mapping[int, tuple[float, ...]]] = MappingProxyType({})
ABSENT: Final = 0.5
"""Probability, before the data are seen, that a family is not there; the other sizes share the rest."""
LEAST_WEIGHT: Final = 1e-4
"""Combinations that are less probable are left out of the mixture."""
_RIDGE: Final = 1e-10
"""Share of a column's own square below which what the parameters leave of it is rounding."""


def require_positive_definite(normal: Floats) -> None:
    """Refuse a normal matrix about which nothing has a covariance.

    Raises
    ------
    NotObservableError
        It is not positive definite.
    """
    if not is_positive_definite(normal):
        raise NotObservableError(
            "the samples do not determine the parameters: their normal matrix is not positive definite",
            PARAMETER_NAMES,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Moments with the parameters eliminated.

    Attributes
    ----------
    inverse : shape (q, q)
        (J'J)^-1.
    carry : shape (q, f)
        (J'J)^-1 J'F: by how much d falls where a rises.
    offset : shape (q,)
        (J'J)^-1 J'y: the step without any term.
    m, v : shape (f, f), (f,)
        M and v.
    squares : float
        S.
    """

    inverse: Floats
    carry: Floats
    offset: Floats
    m: Floats
    v: Floats
    squares: float

    @classmethod
    def of(cls, total: Floats, known: int) -> Reduced:
        """Return what ``total``, products of (J, F, y), leaves of F and y beside the ``known`` columns of J.

        Raises
        ------
        NotObservableError
            J'J is not positive definite: about such an estimate nothing has a covariance.
        """
        q = known
        require_positive_definite(total[:q, :q])
        inverse = scaled_inverse(total[:q, :q])
        found = inverse @ total[:q, q:]
        rest = total[q:, q:] - total[:q, q:].T @ found
        m, v = rest[:-1, :-1], rest[:-1, -1]
        m = 0.5 * (m + m.T) + np.diag(_RIDGE * np.diag(total)[q:-1])
        return cls(inverse, found[:, :-1], found[:, -1], m, v, float(rest[-1, -1]))


@dataclass(frozen=True, slots=True, eq=False)
class Mixture:
    """The posterior of d and a over the sizes that are probable.

    Attributes
    ----------
    sizes : shape (c, families)
        Combinations, the likeliest first.
    weights : shape (c,)
    steps : shape (c, q)
        Mean of d of each, less the step without any term.
    covariances : shape (c, q, q)
        Posterior covariance of d of each.
    terms : shape (c, f)
        Mean of a of each.
    noise : shape (c,)
        Variance of a row that each leaves, in squares of the residual's standard deviation.
    log_evidence : float
        Logarithm of the mean over the prior of the likelihood, up to a constant of the data.
    """

    sizes: Floats
    weights: Floats
    steps: Floats
    covariances: Floats
    terms: Floats
    noise: Floats
    log_evidence: float

    @property
    def step(self) -> Floats:
        """Mean of d less the step without any term, shape (q,)."""
        return np.asarray(self.weights @ self.steps)

    @property
    def term(self) -> Floats:
        """Mean of a, shape (f,)."""
        return np.asarray(self.weights @ self.terms)

    def covariance(self, about: Floats | None = None) -> Floats:
        """Return the covariance of d, shape (q, q), about its mean or about another step ``about``."""
        centre = self.step if about is None else about
        away = self.steps - centre
        return np.asarray(np.tensordot(self.weights, self.covariances, 1) + (self.weights[:, None] * away).T @ away)

    def present(self) -> Floats:
        """Return the probability of each family, shape (families,)."""
        return np.asarray(self.weights @ (self.sizes > 0))


def mixture_of(  # noqa: PLR0917
    reduced: Reduced,
    families: NDArray[np.intp],
    freedom: int,
    share: float,
    sizes: tuple[float, ...] = SIZES,
    own_sizes: Mapping[int, tuple[float, ...]] = NO_SIZES,
) -> Mixture:
    """Return the posterior over all combinations of ``sizes``.

    Parameters
    ----------
    reduced : Reduced
    families : shape (f,)
        Family of each column of F, from 0.
    freedom : int
        Rows less unknowns (nu).
    share : float
        Effective share of the rows (k).
    sizes : tuple of float
        Sizes of each family that are tried, zero first.
    own_sizes : family -> tuple of float
        Those of families that have others.
    """
    count = int(families.max()) + 1 if len(families) else 0
    tried = [own_sizes.get(i, sizes) for i in range(count)]
    grid = np.array(list(itertools.product(*tried)))
    present = np.log([(1.0 - ABSENT) / (len(one) - 1) for one in tried])
    prior = np.sum(np.where(grid > 0, present, np.log(ABSENT)), axis=1)
    logs = prior + log_likelihoods(reduced, grid[:, families] if count else grid, freedom, share)
    top = float(logs.max())
    weights = np.exp(logs - top)
    evidence = top + float(np.log(weights.sum()))
    weights /= weights.sum()
    order = np.argsort(-weights, kind="stable")
    kept = order[weights[order] >= LEAST_WEIGHT]
    weights = weights[kept] / weights[kept].sum()
    return _mixture(reduced, grid[kept], families, weights, freedom, share, evidence)


def log_likelihoods(reduced: Reduced, roots: Floats, freedom: int, share: float) -> Floats:
    """Return the logarithm of the likelihood, up to a constant, under sizes ``roots``, shape (c, f), of each column."""
    c, f = roots.shape
    left = np.full(c, reduced.squares)
    logs = np.zeros(c)
    if f:
        bordered = _bordered(reduced, roots, share, (share * reduced.v)[:, None])
        bordered[:, f, f] = share * max(reduced.squares, 1e-300) * (1.0 + 1e-9)
        factor = np.linalg.cholesky(bordered)
        ends = np.diagonal(factor, axis1=1, axis2=2)
        left = ends[:, f] ** 2 / share
        logs = np.log(ends[:, :f]).sum(axis=1)
    return np.asarray(-logs - 0.5 * freedom * share * np.log(np.maximum(left, 1e-300)))


def _bordered(reduced: Reduced, roots: Floats, share: float, border: Floats) -> Floats:
    """Return I + D^1/2 kM D^1/2 bordered by D^1/2 ``border``, shape (c, f + b, f + b); its corner is left at zero."""
    c, f = roots.shape
    b = border.shape[1]
    made = np.zeros((c, f + b, f + b))
    np.multiply(roots[:, :, None] * roots[:, None, :], share * reduced.m, out=made[:, :f, :f])
    at = np.arange(f)
    made[:, at, at] += 1.0
    side = roots[:, :, None] * border
    made[:, :f, f:] = side
    made[:, f:, :f] = side.swapaxes(1, 2)
    return made


def _mixture(  # noqa: PLR0917
    reduced: Reduced,
    sizes: Floats,
    families: NDArray[np.intp],
    weights: Floats,
    freedom: int,
    share: float,
    evidence: float,
) -> Mixture:
    """Return the mixture of the combinations ``sizes``; each factor is bordered by kv and by (J'J)^-1 J'F."""
    q, f = reduced.carry.shape
    c = len(sizes)
    if f == 0:
        noise = np.full(c, reduced.squares / freedom)
        covariances = (noise / share)[:, None, None] * reduced.inverse
        return Mixture(sizes, weights, np.zeros((c, q)), covariances, np.zeros((c, 0)), noise, evidence)
    roots = sizes[:, families]
    scale = np.sqrt(np.diag(reduced.inverse))
    border = np.concatenate([(share * reduced.v)[:, None], reduced.carry.T / scale], axis=1)
    solved = np.linalg.solve(_bordered(reduced, roots, share, np.zeros((f, 0))), roots[:, :, None] * border)
    terms = roots * solved[:, :, 0]
    noise = np.maximum(reduced.squares - terms @ reduced.v, 1e-12 * reduced.squares) / freedom
    carried = (roots[:, :, None] * border)[:, :, 1:].swapaxes(1, 2) @ solved[:, :, 1:]
    covariances = (reduced.inverse / share + carried * np.outer(scale, scale)) * noise[:, None, None]
    covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
    return Mixture(sizes, weights, -terms @ reduced.carry.T, covariances, terms, noise, evidence)

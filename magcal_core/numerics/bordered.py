"""Bordered block-diagonal matrices: unknowns that all groups of data share, and each group's own.

Notes
-----
Ordered as shared unknowns and then one group's own ones after the other,

    N = [[A, B'], [B, D]],   D = diag(D_1 .. D_n),   S = A - sum B_i' D_i^-1 B_i,
    N^-1 = diag(0, D^-1) + U S^-1 U',   U = [I; -D^-1 B],

so that the inverse is a block-diagonal matrix and one of low rank. Nothing of the size of N squared is ever made: time
and memory grow with the number of groups. All is done with a unit diagonal, so that units cost no digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.errors import NotObservableError
from magcal_core.numerics.linear_algebra import LEAST_PIVOT

_SINGULAR: Final = 1e-14
"""Square of the smallest pivot of an undamped step that is distinguished from rounding, as for dense matrices."""


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Which of a group's p unknowns are shared, shape (s,), and which its own, shape (o,)."""

    shared: NDArray[np.intp]
    own: NDArray[np.intp]

    def places(self, groups: int) -> list[NDArray[np.intp]]:
        """Return where each group's unknowns stand among all of them."""
        s, o = len(self.shared), len(self.own)
        found = []
        for group in range(groups):
            place = np.empty(s + o, np.intp)
            place[self.shared] = np.arange(s)
            place[self.own] = s + group * o + np.arange(o)
            found.append(place)
        return found


@dataclass(frozen=True, slots=True, eq=False)
class BlockAndLowRank:
    """A symmetric matrix diag(0, own) + L core L' of all unknowns.

    Attributes
    ----------
    own : shape (n, o, o)
    left_shared, left_own : shape (s, r), (n, o, r)
        Rows of L.
    core : shape (r, r)
    """

    own: Floats
    left_shared: Floats
    left_own: Floats
    core: Floats

    def diagonal(self) -> Floats:
        """Return the diagonal, shape (q,)."""
        shared = np.sum((self.left_shared @ self.core) * self.left_shared, axis=1)
        low = np.sum((self.left_own @ self.core) * self.left_own, axis=2)
        return np.concatenate([shared, (np.diagonal(self.own, axis1=1, axis2=2) + low).ravel()])

    def of_group(self, group: int, split: Split) -> Floats:
        """Return the part of one group's unknowns, shape (p, p), in the group's own order."""
        left = np.empty((len(split.shared) + len(split.own), self.core.shape[0]))
        left[split.shared], left[split.own] = self.left_shared, self.left_own[group]
        found = np.asarray(left @ self.core @ left.T)
        found[np.ix_(split.own, split.own)] += self.own[group]
        return found

    def dense(self) -> Floats:
        """Return the whole matrix, shape (q, q): for few unknowns."""
        groups, o = self.own.shape[:2]
        left = np.concatenate([self.left_shared, self.left_own.reshape(groups * o, len(self.core))])
        found, s = np.asarray(left @ self.core @ left.T), len(self.left_shared)
        for group in range(groups):
            at = slice(s + group * o, s + (group + 1) * o)
            found[at, at] += self.own[group]
        return found

    def scaled(self, factors: Floats) -> BlockAndLowRank:
        """Return the matrix with row and column i times ``factors[i]``, shape (q,)."""
        groups, o = self.own.shape[:2]
        s = len(self.left_shared)
        shared, own = factors[:s], factors[s:].reshape(groups, o)
        return BlockAndLowRank(
            self.own * own[:, :, None] * own[:, None, :],
            self.left_shared * shared[:, None],
            self.left_own * own[:, :, None],
            self.core,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Bordered:
    """A bordered block-diagonal matrix: A of shape (s, s), B of shape (n, o, s), D of shape (n, o, o)."""

    shared: Floats
    border: Floats
    own: Floats

    @classmethod
    def of(cls, normals: Floats, split: Split) -> Bordered:
        """Return the sum of the groups' matrices, shape (n, p, p), each over its own unknowns."""
        shared, own = split.shared, split.own
        return cls(
            normals[:, shared[:, None], shared].sum(axis=0),
            normals[:, own[:, None], shared],
            normals[:, own[:, None], own],
        )

    def diagonal(self) -> Floats:
        """Return the diagonal, shape (q,)."""
        return np.concatenate([np.diag(self.shared), np.diagonal(self.own, axis1=1, axis2=2).ravel()])

    def quadratic(self, x: Floats) -> float:
        """Return x' N x."""
        s = len(self.shared)
        shared, own = x[:s], x[s:].reshape(self.own.shape[:2])
        crossed = np.einsum("no,nos,s->", own, self.border, shared)
        return float(shared @ self.shared @ shared + 2.0 * crossed + np.einsum("na,nab,nb->", own, self.own, own))

    def inverse(self) -> BlockAndLowRank:
        """Return the inverse as diag(0, E) + U S^-1 U': `left_shared` is the unit matrix.

        Raises
        ------
        NotObservableError
            The matrix is not positive definite: no pivot under a unit diagonal is larger than `LEAST_PIVOT`.
        """
        size = self.diagonal()
        found = None if not (np.isfinite(size).all() and (size > 0.0).all()) else self._inverse(0.0, LEAST_PIVOT)
        if found is None:
            raise NotObservableError("the normal matrix is not positive definite")
        return found

    def damped_step(self, gradient: Floats, damping: float) -> Floats | None:
        """Return -(N + damping diag N)^-1 ``gradient``, shape (q,); None where the matrix is singular."""
        size = self.diagonal()
        if not (np.isfinite(size).all() and (size > 0.0).all()):
            return None
        inverse = self._inverse(damping, _SINGULAR if damping == 0.0 else 0.0)
        return None if inverse is None else -_product(inverse, gradient)

    def _inverse(self, damping: float, smallest: float) -> BlockAndLowRank | None:
        """Return the inverse of N + damping diag N, or None where no pivot above ``smallest`` is left."""
        s, shape = len(self.shared), self.own.shape[:2]
        size = np.sqrt(self.diagonal())
        shared, own = size[:s], size[s:].reshape(shape)
        diagonal_shared, diagonal_own = damping * np.eye(s), damping * np.eye(shape[1])
        border = self.border / own[:, :, None] / shared
        try:
            factor = np.linalg.cholesky(self.own / own[:, :, None] / own[:, None, :] + diagonal_own)
            reduced = np.linalg.solve(factor, border)
            schur = (
                self.shared / np.outer(shared, shared) + diagonal_shared - np.einsum("nos,not->st", reduced, reduced)
            )
            last = np.linalg.cholesky(schur)
        except np.linalg.LinAlgError:
            return None
        pivots = np.concatenate([np.diagonal(factor, axis1=1, axis2=2).ravel(), np.diag(last)])
        if not pivots.min(initial=np.inf) ** 2 > smallest:
            return None
        inverted = np.linalg.solve(factor, np.broadcast_to(np.eye(shape[1]), self.own.shape))
        core = np.linalg.solve(last, np.eye(s))
        return BlockAndLowRank(
            inverted.transpose(0, 2, 1) @ inverted / own[:, :, None] / own[:, None, :],
            np.eye(s),
            -(inverted.transpose(0, 2, 1) @ reduced) / own[:, :, None] * shared,
            core.T @ core / np.outer(shared, shared),
        )


def _product(matrix: BlockAndLowRank, x: Floats) -> Floats:
    s = len(matrix.left_shared)
    own = x[s:].reshape(matrix.own.shape[:2])
    inner = matrix.core @ (matrix.left_shared.T @ x[:s] + np.einsum("nor,no->r", matrix.left_own, own))
    rest = np.einsum("nab,nb->na", matrix.own, own) + matrix.left_own @ inner
    return np.concatenate([matrix.left_shared @ inner, rest.ravel()])

"""Honest errors of several sessions' common estimate, in time that grows with their number.

Notes
-----
The same as `honest_covariance` and `low_frequencies` compute of dense matrices: the blocks of all sessions one after
the other, and what they show at low frequencies. No matrix of all unknowns is made: each block has those of the
sessions that it contains, and the inverse normal matrix is block-diagonal and of low rank (`numerics.bordered`),

    C = diag(0, E) + U S^-1 U',    E_i = D_i^-1.

Of a sum X of blocks, diag(C X C) and diag(C X C X C) follow from X U, session by session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.sessions.hidden_errors import SHARED_SIGN, HiddenErrors
from magcal_core.calibration.uncertainty.honest_covariance import never_below
from magcal_core.calibration.uncertainty.low_frequencies import MERGED_BLOCKS, left_by_fit, processes_of
from magcal_core.numerics.bordered import BlockAndLowRank, Split


@dataclass(frozen=True, slots=True, eq=False)
class JointBlocks:
    """Scores and normal matrices of consecutive blocks over several sessions, each piece of one session.

    Attributes
    ----------
    normals, scores : shape (e, p, p), (e, p)
        Of each piece, sessions one after the other.
    sessions, blocks : shape (e,)
        Which session a piece is of, and which block it is in.
    count : int
        How many blocks there are.
    """

    normals: Floats
    scores: Floats
    sessions: NDArray[np.intp]
    blocks: NDArray[np.intp]
    count: int

    def by_session(self, summed: Floats) -> Floats:
        """Return the pieces' figures, shape (e, ...), summed over each session, shape (n, ...)."""
        return np.add.reduceat(summed, np.flatnonzero(np.diff(self.sessions, prepend=-1)), axis=0)


def pieces_of(starts: Sequence[NDArray[np.intp]]) -> tuple[list[NDArray[np.intp]], list[NDArray[np.intp]], int]:
    """Return where each session's pieces start and which blocks they are in, and how many blocks there are.

    ``starts``: first samples of each session's short blocks, as many of which as needed are put together.
    """
    counts = [len(one) for one in starts]
    total = sum(counts)
    merged = min(total, MERGED_BLOCKS)
    edges = (np.arange(merged) * total) // merged
    block = np.searchsorted(edges, np.arange(total), side="right") - 1
    begins, blocks, before = [], [], 0
    for one, count in zip(starts, counts, strict=True):
        own = block[before : before + count]
        first = np.flatnonzero(np.diff(own, prepend=-1))
        begins.append(one[first])
        blocks.append(own[first])
        before += count
    return begins, blocks, merged


def joint_honest_covariance(
    pieces: JointBlocks, formal: BlockAndLowRank, split: Split, duration_s: float
) -> BlockAndLowRank:
    """Return the ``formal`` covariance with the variances that the scores show (`honest_covariance`).

    ``formal``: inverse of the sum of the pieces' normal matrices, as `Bordered.inverse` returns it.
    """
    processes = processes_of(pieces.count, duration_s)
    weights = processes.cosines[pieces.blocks]
    white = np.array([_white(pieces, column, formal, split) for column in weights.T])
    diagonal = formal.diagonal()
    variances = processes.widening(_power(pieces, weights, formal, split) / white) * diagonal
    honest = never_below(variances, weights.shape[1], diagonal)
    return formal.scaled(np.sqrt(honest / np.maximum(diagonal, 1e-300)))


def _power(pieces: JointBlocks, weights: Floats, formal: BlockAndLowRank, split: Split) -> Floats:
    """Return the squares of C times the scores' cosine transform, shape (k, q)."""
    transformed = pieces.by_session(weights[:, :, None] * pieces.scores[:, None, :])
    shared, own = transformed[:, :, split.shared].sum(axis=0), transformed[:, :, split.own]
    inner = (shared + np.einsum("nko,nos->ks", own, formal.left_own)) @ formal.core
    rest = own @ formal.own + np.einsum("ks,nos->nko", inner, formal.left_own)
    return np.asarray(np.concatenate([inner, rest.transpose(1, 0, 2).reshape(len(inner), -1)], axis=1) ** 2)


def _white(pieces: JointBlocks, cosine: Floats, formal: BlockAndLowRank, split: Split) -> Floats:
    """Return the power of white noise at one frequency after the fit, shape (q,): what the fit took up is off."""
    before = pieces.by_session(cosine[:, None, None] ** 2 * pieces.normals)
    shared = pieces.by_session(cosine[:, None, None] * pieces.normals)
    return left_by_fit(_twice(before, formal, split), _thrice(shared, formal, split))


def _onto(sums: Floats, formal: BlockAndLowRank, split: Split) -> tuple[Floats, Floats]:
    """Return U'X U, shape (s, s), and the own rows of X U, shape (n, o, s), of the sessions' matrices X."""
    shared, own, left = split.shared, split.own, formal.left_own
    onto_shared = sums[:, shared[:, None], shared] + sums[:, shared[:, None], own] @ left
    onto_own = sums[:, own[:, None], shared] + sums[:, own[:, None], own] @ left
    return onto_shared.sum(axis=0) + np.einsum("nos,not->st", left, onto_own), onto_own


def _twice(sums: Floats, formal: BlockAndLowRank, split: Split) -> Floats:
    """Return diag(C X C), shape (q,), of the sessions' matrices X, shape (n, p, p)."""
    inner, onto_own = _onto(sums, formal, split)
    core, steps = formal.core, formal.left_own @ formal.core
    shared = np.sum((core @ inner) * core, axis=1)
    alone = np.sum((formal.own @ sums[:, split.own[:, None], split.own]) * formal.own, axis=2)
    own = alone + 2.0 * np.sum((formal.own @ onto_own) * steps, axis=2) + np.sum((steps @ inner) * steps, axis=2)
    return np.concatenate([shared, own.ravel()])


def _thrice(sums: Floats, formal: BlockAndLowRank, split: Split) -> Floats:
    """Return diag(C X C X C), shape (q,), of the sessions' matrices X, shape (n, p, p)."""
    inner, onto_own = _onto(sums, formal, split)
    core, steps = formal.core, formal.left_own @ formal.core
    spread = formal.own @ onto_own
    whole = np.einsum("nos,not->st", onto_own, spread) + inner @ core @ inner
    shared = np.sum((core @ whole) * core, axis=1)
    alone = formal.own @ sums[:, split.own[:, None], split.own]
    crossed = alone @ spread + spread @ core @ inner
    own = (
        np.sum((alone @ formal.own) * alone, axis=2)
        + np.sum((spread @ core) * spread, axis=2)
        + 2.0 * np.sum(crossed * steps, axis=2)
        + np.sum((steps @ whole) * steps, axis=2)
    )
    return np.concatenate([shared, own.ravel()])


def with_hidden(
    covariance: BlockAndLowRank, formal: BlockAndLowRank, split: Split, hidden: Sequence[HiddenErrors]
) -> BlockAndLowRank:
    """Return the ``covariance`` of all unknowns with what is ``hidden`` in each session.

    What a field model lacks has the same sign in every session, all else is independent.

    Notes
    -----
    An error of one session's parameters moves the shared unknowns by its shared part, and those of another session i
    by U_i times that, as the estimate would; its own ones by their part.
    """
    n, o = formal.own.shape[:2]
    s = len(split.shared)
    own, crossed, total = covariance.own.copy(), np.zeros((n, o, s)), np.zeros((s, s))
    lasting: dict[str, Floats] = {}
    for i, one in enumerate(hidden):
        left = formal.left_own[i]
        apart = one.locked[split.own] - left @ one.locked[split.shared]
        own[i] += apart[:, split.own] - apart[:, split.shared] @ left.T
        crossed[i] += apart[:, split.shared]
        total += one.locked[np.ix_(split.shared, split.shared)]
        for name, push in zip(one.sources, one.pushes, strict=True):
            moved = formal.core @ (push[split.shared] + left.T @ push[split.own])
            beside = formal.own[i] @ push[split.own]
            if name.startswith(SHARED_SIGN):
                shift = lasting.setdefault(name, np.zeros(s + n * o))
                shift[:s] += moved
                shift[s + i * o : s + (i + 1) * o] += beside
            else:
                own[i] += np.outer(beside, beside)
                crossed[i] += np.outer(beside, moved)
                total += np.outer(moved, moved)
    shifts = np.array(list(lasting.values())).reshape(len(lasting), s + n * o).T
    return _put_together(covariance, formal.left_own, _Added(own, crossed, total, shifts))


@dataclass(frozen=True, slots=True, eq=False)
class _Added:
    """What stands beside a covariance: diag(own) + U total U' + crossed U' + U crossed' + shifts of one sign squared.

    ``crossed`` has the shape (n, o, s), ``shifts`` (q, k), of which those of the own unknowns lack U times the shared.
    """

    own: Floats
    crossed: Floats
    total: Floats
    shifts: Floats


def _put_together(covariance: BlockAndLowRank, left_own: Floats, added: _Added) -> BlockAndLowRank:
    """Return ``covariance`` with what is ``added``; ``left_own`` are the own rows of U."""
    n, o, s = added.crossed.shape
    r, k = len(covariance.core), added.shifts.shape[1]
    shared, own = added.shifts[:s], added.shifts[s:].reshape(n, o, k) + left_own @ added.shifts[:s]
    core = np.zeros((r + 2 * s + k, r + 2 * s + k))
    core[:r, :r] = covariance.core
    core[r : r + s, r : r + s] = added.total
    core[r : r + s, r + s : r + 2 * s] = core[r + s : r + 2 * s, r : r + s] = np.eye(s)
    core[r + 2 * s :, r + 2 * s :] = np.eye(k)
    left_shared = np.concatenate([covariance.left_shared, np.eye(s), np.zeros((s, s)), shared], axis=1)
    parts = [covariance.left_own, left_own, added.crossed, own]
    return BlockAndLowRank(added.own, left_shared, np.concatenate(parts, axis=2), core)

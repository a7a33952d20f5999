"""Errors of many sessions' common estimate against the same computed of dense matrices of all unknowns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.calibration.sessions.hidden_errors import SHARED_SIGN, HiddenErrors
from magcal_core.calibration.sessions.joint_errors import JointBlocks, joint_honest_covariance, pieces_of, with_hidden
from magcal_core.calibration.uncertainty.honest_covariance import honest_covariance
from magcal_core.numerics.blocks import BlockScores, block_starts
from magcal_core.numerics.bordered import Bordered, Split
from magcal_core.numerics.linear_algebra import scaled_inverse

P = 9
DURATION_S = 5e5
SPLITS = {
    "axes shared": Split(np.arange(3, 9), np.arange(3)),
    "one shared": Split(np.array([4]), np.array([0, 1, 2, 3, 5, 6, 7, 8])),
    "all shared": Split(np.arange(9), np.zeros(0, np.intp)),
    "none shared": Split(np.zeros(0, np.intp), np.arange(9)),
}


def sessions_of(rng: np.random.Generator, lengths: Sequence[int]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows and residuals of sessions: columns of unlike size, and residuals that remember their neighbours."""
    made = []
    for n in lengths:
        rows = rng.normal(size=(n, P)) @ (np.eye(P) + 0.2 * rng.normal(size=(P, P))) * np.repeat([1.0, 4e4, 700.0], 3)
        wave = np.convolve(rng.normal(size=n + 40), np.ones(41) / 6.0, mode="valid")
        made.append((rows, rng.normal(size=n) + wave))
    return made


def pieces(sessions, starts) -> tuple[JointBlocks, list[NDArray[np.intp]]]:
    begins, blocks, count = pieces_of(starts)
    normals, scores, numbers = [], [], []
    for i, ((rows, r), begin) in enumerate(zip(sessions, begins, strict=True)):
        for first, last in zip(begin, [*begin[1:], len(r)], strict=True):
            normals.append(rows[first:last].T @ rows[first:last])
            scores.append(rows[first:last].T @ r[first:last])
            numbers.append(i)
    return JointBlocks(np.array(normals), np.array(scores), np.array(numbers), np.concatenate(blocks), count), begins


def dense_blocks(sessions, starts, split: Split) -> BlockScores:
    """Return the same short blocks with all unknowns in each."""
    places, before = split.places(len(sessions)), 0
    q = len(split.shared) + len(sessions) * len(split.own)
    scores, normals, firsts = [], [], []
    for (rows, r), begin, place in zip(sessions, starts, places, strict=True):
        for first, last in zip(begin, [*begin[1:], len(r)], strict=True):
            score, normal = np.zeros(q), np.zeros((q, q))
            score[place] = rows[first:last].T @ r[first:last]
            normal[np.ix_(place, place)] = rows[first:last].T @ rows[first:last]
            scores.append(score)
            normals.append(normal)
            firsts.append(before + first)
        before += len(r)
    return BlockScores(np.array(scores), np.array(normals), np.array(firsts, np.intp), np.eye(q))


@pytest.mark.parametrize("split", SPLITS.values(), ids=SPLITS.keys())
@pytest.mark.parametrize("lengths", [[500], [300, 700, 41, 9, 120], [60] * 12], ids=["one", "unlike", "many"])
def test_honest_errors_are_those_of_dense_matrices(split: Split, lengths: list[int]) -> None:
    """To 1e-9 of the errors: both are roundings of the same sums."""
    sessions = sessions_of(np.random.default_rng(len(lengths)), lengths)
    starts = [block_starts(n, 30) for n in lengths]
    found, _ = pieces(sessions, starts)
    formal = Bordered.of(found.by_session(found.normals), split).inverse()
    honest = joint_honest_covariance(found, formal, split, DURATION_S).dense()
    dense = dense_blocks(sessions, starts, split)
    expected = scaled_inverse(dense.normals.sum(axis=0))
    errors = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        formal.dense() / np.outer(errors, errors), expected / np.outer(errors, errors), atol=1e-9
    )
    reference = honest_covariance(dense, expected, sum(lengths), DURATION_S).covariance
    assert np.max(np.diag(reference) / np.diag(expected)) > 1.5
    errors = np.sqrt(np.diag(reference))
    np.testing.assert_allclose(honest / np.outer(errors, errors), reference / np.outer(errors, errors), atol=1e-9)


def hidden_in(rng: np.random.Generator, size: np.ndarray) -> HiddenErrors:
    root = rng.normal(size=(P, P)) * size[:, None]
    names = (f"{SHARED_SIGN}_field", "orbit_along_track", "attitude")
    return HiddenErrors(root @ root.T, rng.normal(size=(3, P)) / size, names)


@pytest.mark.parametrize("split", SPLITS.values(), ids=SPLITS.keys())
def test_what_is_hidden_moves_the_others_as_the_estimate_would(split: Split) -> None:
    """Against carrying every session's error on to all unknowns with dense matrices."""
    rng = np.random.default_rng(7)
    sessions = sessions_of(rng, [80, 200, 150, 60])
    found, _ = pieces(sessions, [block_starts(len(r), 30) for _, r in sessions])
    normal = Bordered.of(found.by_session(found.normals), split)
    formal = normal.inverse()
    dense = formal.dense()
    hidden = [hidden_in(rng, np.sqrt(np.diag(formal.of_group(i, split)))) for i in range(len(sessions))]
    expected, lasting = dense.copy(), np.zeros(len(dense))
    for place, one in zip(split.places(len(sessions)), hidden, strict=True):
        carry = dense[:, place] @ scaled_inverse(dense[np.ix_(place, place)])
        expected += carry @ one.locked @ carry.T
        shifts = one.pushes @ dense[place]
        lasting += shifts[0]
        expected += shifts[1:].T @ shifts[1:]
    expected += np.outer(lasting, lasting)
    errors = np.sqrt(np.diag(expected))
    whole = with_hidden(formal, formal, split, hidden).dense()
    np.testing.assert_allclose(whole / np.outer(errors, errors), expected / np.outer(errors, errors), atol=1e-9)

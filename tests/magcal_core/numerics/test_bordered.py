"""Bordered block-diagonal matrices against dense ones."""

from __future__ import annotations

import numpy as np
import pytest

from magcal_core.errors import NotObservableError
from magcal_core.numerics.bordered import Bordered, Split
from magcal_core.numerics.bordered_search import Sums, minimise_bordered
from magcal_core.numerics.levenberg_marquardt import damped_step, minimise

SPLIT = Split(np.array([1, 3]), np.array([0, 2, 4]))


def normals_of(rng: np.random.Generator, groups: int) -> np.ndarray:
    rows = rng.normal(size=(groups, 30, 5)) * np.array([1.0, 1e4, 30.0, 1e-3, 5.0])
    return np.asarray(rows.transpose(0, 2, 1) @ rows)


def dense_of(normals: np.ndarray) -> np.ndarray:
    groups = len(normals)
    dense = np.zeros((2 + 3 * groups, 2 + 3 * groups))
    for place, normal in zip(SPLIT.places(groups), normals, strict=True):
        dense[np.ix_(place, place)] += normal
    return dense


@pytest.mark.parametrize("groups", [1, 7])
def test_inverse_parts_and_forms_are_those_of_the_dense_matrix(groups: int) -> None:
    """To 1e-11 under a unit diagonal: the matrices are well conditioned."""
    rng = np.random.default_rng(groups)
    normals = normals_of(rng, groups)
    bordered, dense = Bordered.of(normals, SPLIT), dense_of(normals)
    size = np.sqrt(np.diag(dense))
    expected = np.linalg.inv(dense / np.outer(size, size))
    inverse = bordered.inverse()
    np.testing.assert_allclose(inverse.dense() * np.outer(size, size), expected, atol=1e-11)
    np.testing.assert_allclose(inverse.diagonal() * size**2, np.diag(expected), rtol=1e-11)
    place, last = SPLIT.places(groups)[-1], groups - 1
    np.testing.assert_allclose(inverse.of_group(last, SPLIT), inverse.dense()[np.ix_(place, place)], rtol=1e-12)
    np.testing.assert_allclose(bordered.diagonal(), np.diag(dense), rtol=1e-14)
    x = rng.normal(size=len(dense)) / size
    assert bordered.quadratic(x) == pytest.approx(x @ dense @ x, rel=1e-12)
    np.testing.assert_allclose(
        inverse.scaled(size).dense(), inverse.dense() * np.outer(size, size), rtol=1e-12, atol=1e-15
    )


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_damped_step_is_that_of_the_dense_matrix(damping: float) -> None:
    rng = np.random.default_rng(3)
    normals = normals_of(rng, 4)
    dense = dense_of(normals)
    gradient, expected = rng.normal(size=len(dense)) * np.sqrt(np.diag(dense)), np.empty(len(dense))
    assert damped_step(dense, gradient, damping, expected)
    found = Bordered.of(normals, SPLIT).damped_step(gradient, damping)
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_what_nothing_determines_has_no_inverse_and_no_undamped_step() -> None:
    normals = normals_of(np.random.default_rng(4), 3)
    twice = normals.copy()
    twice[1, 2], twice[1, :, 2] = twice[1, 0], twice[1, :, 0]
    dead = normals.copy()
    dead[:, 1], dead[:, :, 1] = 0.0, 0.0
    for normal in (twice, dead, np.full_like(normals, np.nan)):
        with pytest.raises(NotObservableError):
            Bordered.of(normal, SPLIT).inverse()
        assert Bordered.of(normal, SPLIT).damped_step(np.ones(11), 0.0) is None
    assert Bordered.of(twice, SPLIT).damped_step(np.ones(11), 1e-3) is not None


def test_the_search_goes_where_the_dense_one_goes() -> None:
    """Exponentials with a common rate and sizes of their own, from a start that needs damping."""
    rng = np.random.default_rng(5)
    t = np.linspace(0.0, 2.0, 40)
    size, rate = np.array([1.0, 3.0, 0.5]), 1.7
    y = size[:, None] * np.exp(-rate * t) + 0.01 * rng.normal(size=(3, 40))
    split = Split(np.array([0]), np.array([1]))

    def parts(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        decay = np.exp(-theta[0] * t)
        rows = np.stack([-theta[1:, None] * t * decay, np.broadcast_to(decay, (3, 40))], axis=1)
        r = theta[1:, None] * decay - y
        return rows @ rows.transpose(0, 2, 1), np.sum(rows * r[:, None, :], axis=2), float(np.sum(r**2))

    def evaluate(theta: np.ndarray) -> Sums:
        normals, gradients, cost = parts(theta)
        return Sums(Bordered.of(normals, split), np.concatenate([[gradients[:, 0].sum()], gradients[:, 1]]), cost)

    def fill(theta: np.ndarray, normal: np.ndarray, gradient: np.ndarray) -> float:
        normals, gradients, cost = parts(theta)
        normal[:, :] = 0.0
        normal[0, 0] = normals[:, 0, 0].sum()
        for i in range(3):
            normal[0, i + 1] = normal[i + 1, 0] = normals[i, 0, 1]
            normal[i + 1, i + 1] = normals[i, 1, 1]
        gradient[:] = [gradients[:, 0].sum(), *gradients[:, 1]]
        return cost

    start = np.array([-1.0, 5.0, 5.0, 5.0])
    floor = float(np.sqrt(np.sum(y**2)))
    found, expected = minimise_bordered(evaluate, start, floor), minimise(fill, start, floor)
    assert found.is_converged
    assert expected.is_converged
    np.testing.assert_allclose(found.theta, expected.theta, rtol=1e-10)
    np.testing.assert_allclose(found.theta, [rate, *size], atol=0.05)

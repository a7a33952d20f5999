"""Posterior over sizes, against the dense likelihood and generalised least squares of the same model."""

import itertools

import numpy as np
import pytest

from magcal_core.calibration.terms.evidence import (
    ABSENT,
    SIZES,
    Reduced,
    log_likelihoods,
    mixture_of,
)

N, Q, FAMILIES = 60, 4, np.array([0, 0, 1, 1, 1])


@pytest.fixture(scope="module")
def model():
    """Rows y = J d + F a + noise with one family there and one not; the columns of J differ by 1e6 in size."""
    rng = np.random.default_rng(3)
    jacobian = rng.normal(size=(N, Q)) * [1.0, 40000.0, 300.0, 0.01]
    terms = rng.normal(size=(N, len(FAMILIES))) + 0.5 * jacobian[:, :1]
    y = jacobian @ [1.0, 1e-4, -2e-3, 30.0] + terms[:, :2] @ [0.8, -0.5] + rng.normal(size=N)
    design = np.column_stack([jacobian, terms, y])
    return jacobian, terms, y, Reduced.of(design.T @ design, Q)


def dense(jacobian, terms, y, roots, share=1.0):
    """Restricted likelihood, estimate and covariance of d under V = I + F D F'; every row counts ``share`` times."""
    v = np.eye(len(y)) / share + terms @ np.diag(roots**2) @ terms.T
    weights = np.linalg.inv(v)
    normal = jacobian.T @ weights @ jacobian
    d = np.linalg.solve(normal, jacobian.T @ weights @ y)
    left = y - jacobian @ d
    squares = float(left @ weights @ left)
    sizes = np.linalg.slogdet(v)[1] + np.linalg.slogdet(normal)[1]
    return -0.5 * sizes - 0.5 * (len(y) - Q) * np.log(squares), d, np.linalg.inv(normal), squares


def test_likelihoods_are_the_restricted_ones(model):
    """Differences between sizes, all 25 of two families, to rounding."""
    jacobian, terms, y, reduced = model
    roots = np.array(list(itertools.product(SIZES, repeat=2)))[:, FAMILIES]
    ours = log_likelihoods(reduced, roots, N - Q, 1.0)
    theirs = np.array([dense(jacobian, terms, y, row)[0] for row in roots])
    np.testing.assert_allclose(ours - ours[0], theirs - theirs[0], atol=1e-6)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_posterior_is_that_of_generalised_least_squares(model, share):
    jacobian, terms, y, reduced = model
    found = mixture_of(reduced, FAMILIES, N - Q, share)
    for sizes, step, covariance in zip(found.sizes, found.steps, found.covariances, strict=True):
        _, d, inverse, squares = dense(jacobian, terms, y, sizes[FAMILIES], share)
        noise = squares / share / (N - Q)
        scale = np.sqrt(np.diag(inverse) * noise)
        np.testing.assert_allclose((reduced.offset + step) / scale, d / scale, atol=1e-5)
        size = np.outer(scale, scale)
        np.testing.assert_allclose(covariance / size, inverse * noise / size, atol=1e-5)


def test_probabilities_name_the_family_that_is_there(model):
    found = mixture_of(model[3], FAMILIES, N - Q, 1.0)
    there, not_there = found.present()
    assert there > 0.95
    assert not_there < 0.5
    assert found.weights.sum() == pytest.approx(1.0)


def test_nothing_to_weigh_is_the_plain_fit(model):
    """No family: step zero, the formal covariance; a third of the rows' worth makes it three times as large."""
    jacobian, _, y, _ = model
    design = np.column_stack([jacobian, y])
    reduced = Reduced.of(design.T @ design, Q)
    whole, third = (mixture_of(reduced, np.zeros(0, np.intp), N - Q, share) for share in (1.0, 1.0 / 3.0))
    left = y - jacobian @ np.linalg.lstsq(jacobian, y, rcond=None)[0]
    want = np.linalg.inv(jacobian.T @ jacobian) * float(left @ left) / (N - Q)
    np.testing.assert_allclose(whole.covariance(), want, rtol=1e-6)
    np.testing.assert_allclose(third.covariance(), 3.0 * want, rtol=1e-6)
    assert not whole.step.any()


def test_prior_gives_absence_half():
    """Noise alone, of no use for any term: the prior comes back."""
    total = np.diag([100.0, 1e-9, 1e-9, 100.0])
    found = mixture_of(Reduced.of(total, 1), np.array([0, 1]), 99, 1.0)
    np.testing.assert_allclose(found.present(), 1.0 - ABSENT, atol=1e-6)

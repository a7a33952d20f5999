"""The compiled regressions against QR and reweighting in plain numpy, and their medians against numpy's."""

import numpy as np
import pytest

from magcal_core.calibration.diagnosis.affine import fit_affine
from magcal_core.calibration.estimators.closed_form_rows import fit_inverse_rows, reweighted_inverse
from magcal_core.calibration.estimators.vector_rows import fit_rows, refitted, reweighted
from magcal_core.errors import NotObservableError
from magcal_core.numerics.medians import median_size
from magcal_core.numerics.regression import block_sums
from magcal_core.numerics.robust import LOSSES, robust_sigma, weights_and_slopes
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows

ROBUST = [loss for loss in LOSSES if loss != "none"]


def _by_qr(design, target, weights):
    """Weighted least squares by QR of the centred, scaled columns: coefficients, residuals."""
    root = np.sqrt(weights)
    centre = weights @ design / weights.sum()
    spread = np.sqrt(weights @ (design - centre) ** 2 / weights.sum())
    middle = weights @ target / weights.sum()
    q, r = np.linalg.qr((design - centre) / spread * root[:, None])
    found = np.linalg.solve(r, q.T @ ((target - middle) * root)) / spread
    return found, middle - centre @ found, target - middle - (design - centre) @ found


def _reweighted_by_qr(designs, targets, prior, robust):
    """Reweight by the worst of three residuals until nothing moves, one QR a target and round."""
    weights = prior
    for name in ("none", "soft_l1", robust):
        for _ in range(60 if name != "none" else 1):
            found = [_by_qr(design, targets[:, i], weights) for i, design in enumerate(designs)]
            errors = np.column_stack([row[2] for row in found])
            if name != "none":
                scales = [robust_sigma(errors[prior > 0, i]) for i in range(3)]
                weights = prior * weights_and_slopes(np.abs(errors / scales).max(axis=1), name, 1.0)[0]
        if name == "none" and robust != "none":
            scales = [robust_sigma(errors[prior > 0, i]) for i in range(3)]
            weights = prior * weights_and_slopes(np.abs(errors / scales).max(axis=1), "soft_l1", 1.0)[0]
    return found, weights


def _arrays(mission, seed=3, n=700):
    samples = mission(n=n, noise_nt=90.0, seed=seed).samples
    random = np.random.default_rng(seed)
    struck = random.random(n) < 0.03
    h_nt = samples.h_nt.copy()
    h_nt[struck, 1] += 6000.0
    prior = np.where(random.random(n) < 0.1, 0.0, random.uniform(0.5, 2.0, n))
    return h_nt, samples.b_ref_base_nt, random.normal(size=(n, 2)), prior


def test_rows_are_those_of_qr(mission):
    """Residuals of some 100 nT from readings of 5e4 nT: 1e-9 nT is rounding."""
    h_nt, b_nt, z, prior = _arrays(mission)
    rows = fit_rows(h_nt, b_nt, z, prior)
    for axis in range(3):
        found, bias, errors = _by_qr(np.column_stack([b_nt[:, : axis + 1], z]), h_nt[:, axis], prior)
        np.testing.assert_allclose(rows.matrix[axis, : axis + 1], found[: axis + 1], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(rows.slopes_nt[:, axis], found[axis + 1 :], rtol=1e-9)
        np.testing.assert_allclose(rows.bias_nt[axis], bias, rtol=1e-10)
        np.testing.assert_allclose(rows.residuals_nt[:, axis], errors, atol=1e-8)
        design = np.column_stack([b_nt[:, : axis + 1], np.ones(len(b_nt)), z])
        sigma = np.sqrt(prior @ errors**2 / (np.count_nonzero(prior) - design.shape[1]))
        covariance = np.linalg.inv((design * prior[:, None]).T @ design) * sigma**2
        np.testing.assert_allclose(rows.sigma_nt[axis], sigma, rtol=1e-10)
        np.testing.assert_allclose(
            rows.covariances[axis],
            covariance,
            rtol=1e-7,
            atol=1e-9 * np.sqrt(np.outer(*[np.diag(covariance)] * 2)).max(),
        )


@pytest.mark.parametrize("spread", [1e-2, 1e-4, 2e-5])
def test_a_field_of_small_spread_costs_no_digits(mission, spread):
    """A component that hardly varies: as good as QR, where normal equations alone would lose twice the digits."""
    samples = mission(noise_nt=0.0).samples
    b_nt = samples.b_ref_base_nt.copy()
    b_nt[:, 1] = 20000.0 + 0.7 * b_nt[:, 0] + spread * b_nt[:, 1]
    truth = np.array([[1.02, 0.0, 0.0], [-0.07, 0.98, 0.0], [0.03, 0.11, 1.04]])
    h_nt = b_nt @ truth.T + np.array([3000.0, -1000.0, 500.0])
    rows = fit_rows(h_nt, b_nt, np.zeros((len(h_nt), 0)), np.ones(len(h_nt)))
    np.testing.assert_allclose(rows.matrix, truth, atol=1e-14 / spread)


@pytest.mark.parametrize("robust", ROBUST)
def test_robust_rows_are_those_of_qr(mission, robust):
    """Both end where the residuals move by less than 1e-9 of the noise, 1e-7 nT."""
    h_nt, b_nt, z, prior = _arrays(mission)
    rows = reweighted(h_nt, b_nt, z, prior, robust)
    designs = [np.column_stack([b_nt[:, : axis + 1], z]) for axis in range(3)]
    found, weights = _reweighted_by_qr(designs, h_nt, prior, robust)
    for axis in range(3):
        np.testing.assert_allclose(rows.residuals_nt[:, axis], found[axis][2], atol=1e-5)
        np.testing.assert_allclose(rows.bias_nt[axis], found[axis][1], atol=1e-5)
    np.testing.assert_allclose(rows.weights, weights, atol=1e-6)


@pytest.mark.parametrize("robust", ROBUST)
def test_robust_rows_from_known_weights_end_where_they_end_without(mission, robust):
    """The start decides how long it takes, not where it ends."""
    h_nt, b_nt, z, prior = _arrays(mission)
    rows = reweighted(h_nt, b_nt, z, prior, robust)
    again = reweighted(h_nt, b_nt, z, prior, robust, near=rows.weights)
    np.testing.assert_allclose(again.residuals_nt, rows.residuals_nt, atol=1e-5)
    assert again.rounds <= rows.rounds


@pytest.mark.parametrize("robust", ["none", "huber"])
def test_inverse_rows_are_those_of_qr(mission, robust):
    """Residuals to 1e-5 nT, as above."""
    h_nt, b_nt, _, prior = _arrays(mission)
    rows = reweighted_inverse(h_nt, b_nt, prior, robust)
    designs = [np.column_stack([b_nt[:, :axis], h_nt[:, axis]]) for axis in range(3)]
    if robust == "none":
        found = [_by_qr(design, b_nt[:, axis], prior) for axis, design in enumerate(designs)]
    else:
        found, _ = _reweighted_by_qr(designs, b_nt, prior, robust)
    for axis in range(3):
        np.testing.assert_allclose(rows.residuals_nt[:, axis], found[axis][2], atol=1e-5)
        np.testing.assert_allclose(rows.gains[axis], found[axis][0][-1], rtol=1e-10)
        np.testing.assert_allclose(-rows.below[axis, :axis], found[axis][0][:-1], atol=1e-10)
        np.testing.assert_allclose(rows.intercepts_nt[axis], found[axis][1], atol=1e-5)
    plain = fit_inverse_rows(h_nt, b_nt, prior)
    noiseless = fit_inverse_rows(h_nt, b_nt, prior, np.zeros(3))
    np.testing.assert_allclose(plain.matrix, noiseless.matrix, atol=1e-10)


def test_affine_maps_are_those_of_plain_reweighting(mission):
    """Six rounds of Huber's loss by lstsq, step by step the same: 1e-6 nT of residuals up to 6000 nT."""
    h_nt, b_nt, _, prior = _arrays(mission)
    fast = fit_affine(np.arange(len(h_nt)), b_nt, h_nt, prior, is_robust=True)
    weights = prior
    for _ in range(6):
        design = np.column_stack([b_nt, np.ones(len(b_nt))])
        root = np.sqrt(weights)[:, None]
        found = np.linalg.lstsq(design * root, h_nt * root, rcond=None)[0]
        errors = h_nt - design @ found
        size = np.linalg.norm(errors, axis=1) / np.sqrt(3.0)
        weights = prior * weights_and_slopes(size, "huber", robust_sigma(size[prior > 0]))[0]
    np.testing.assert_allclose(fast.matrix, found[:3].T, atol=1e-10)
    np.testing.assert_allclose(fast.offset, found[3], atol=1e-6)
    np.testing.assert_allclose(fast.residuals, errors, atol=1e-6)
    np.testing.assert_allclose(fast.weights, weights, atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1001, 5000])
@pytest.mark.parametrize("guess", [-1.0, 0.9, 1.0, 1.3, 50.0])
def test_medians_are_those_of_numpy(count, guess):
    """Exact, whatever the guess; ties included."""
    random = np.random.default_rng(count)
    for values in (random.normal(size=count), np.round(random.normal(size=count), 1)):
        prior = (random.random(count) < 0.8).astype(np.float64)
        prior[0] = 1.0
        want = float(np.median(np.abs(values[prior > 0])))
        got = median_size(values, prior, guess * want, 0.05, np.empty(count))
        assert got == want


def test_block_sums_are_sums():
    """Block by block against numpy: rounding only."""
    random = np.random.default_rng(2)
    columns, errors, weights = random.normal(size=(4, 700)), random.normal(size=(3, 700)), random.random(700)
    starts = np.array([0, 5, 300, 301])
    table = np.concatenate([columns, np.ones((1, 700)), errors])
    for block, (i, j) in enumerate([(0, 5), (5, 300), (300, 301), (301, 700)]):
        want = (table[:, i:j] * weights[i:j]) @ table[:, i:j].T
        np.testing.assert_allclose(block_sums(columns, errors, weights, starts)[block], want, rtol=1e-10, atol=1e-12)


def test_a_repeated_regressor_is_refused(mission):
    """The same column twice: no estimate, rather than one of infinitely many."""
    h_nt, b_nt, z, prior = _arrays(mission)
    with pytest.raises(NotObservableError, match="regressors"):
        fit_rows(h_nt, b_nt, np.column_stack([z[:, 0], z[:, 0]]), prior)


def test_repeated_runs_are_equal(mission):
    """Nothing of one fit remains in the next."""
    h_nt, b_nt, z, prior = _arrays(mission)
    one, other = (reweighted(h_nt, b_nt, z, prior, "huber") for _ in range(2))
    np.testing.assert_array_equal(one.residuals_nt, other.residuals_nt)
    assert one.rounds == other.rounds


@pytest.mark.parametrize("robust", list(LOSSES))
def test_a_refit_from_known_parameters_ends_where_the_whole_fit_does(mission, robust):
    """To a millionth of 90 nT of noise: 1e-4 nT of the bias, 1e-8 of the scale, 1e-6 deg."""
    h_nt, b_nt, columns, prior = _arrays(mission)
    z = Standardised.of(("a", "b"), list(columns.T), len(prior))

    def whole(weights):
        rows = reweighted(h_nt, b_nt, z.columns, weights, robust)
        return parameters_from_rows(rows.matrix, rows.bias_nt, rows.slopes_nt, z)

    part = prior.copy()
    part[200:330] = 0.0
    want, got = whole(part), refitted(h_nt, b_nt, z, part, robust, whole(prior))
    np.testing.assert_allclose(got.bias_nt, want.bias_nt, atol=1e-4)
    np.testing.assert_allclose(got.scale, want.scale, atol=1e-8)
    np.testing.assert_allclose(got.nonorthogonality_deg, want.nonorthogonality_deg, atol=1e-6)
    for name in z.names:
        np.testing.assert_allclose(got.regressors[name], want.regressors[name], atol=1e-4)

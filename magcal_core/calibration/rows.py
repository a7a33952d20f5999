"""Rows of h = T B + b by weighted linear least squares, with robust weights that all three axes share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.fit import Observations
from magcal_core.calibration.jacobians import Standardised
from magcal_core.calibration.weights import robust_sigma, weights_and_slopes
from magcal_core.sensor import lower_triangular_gauge

Floats = NDArray[np.float64]

_ROUNDS: Final = 100
MISALIGNED_P: Final = 1e-6
"""Probability below which the lower-triangular hypothesis is given up."""
MISALIGNED_DEG: Final = 0.1
"""Rotation below which a misalignment is not worth a warning, deg."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Three regressions and what was used to make them.

    Attributes
    ----------
    b_nt, z : shape (n, 3), (n, k)
        Field in the base frame, nT; standardised regressors.
    matrix, bias_nt, slopes_nt : shape (3, 3), (3,), (k, 3)
    residuals_nt : shape (n, 3)
        h - model, nT, along the sensor's axes.
    sigma_nt : shape (3,)
        Noise of each axis, nT: root of RSS / (n - unknowns of the row).
    weights : shape (n,)
    softening, softening_slope : float
        What a robust loss multiplies the formal covariance by, and divides the normal matrix by.
    """

    b_nt: Floats
    z: Floats
    matrix: Floats
    bias_nt: Floats
    slopes_nt: Floats
    residuals_nt: Floats
    sigma_nt: Floats
    weights: Floats
    covariances: tuple[Floats, Floats, Floats]
    softening: float = 1.0
    softening_slope: float = 1.0
    rounds: int = 1
    is_converged: bool = True

    def design(self, axis: int) -> Floats:
        """Return the regressors of one row, shape (n, axis + 2 + k)."""
        return np.column_stack([self.b_nt[:, : axis + 1], np.ones(len(self.b_nt)), self.z])

    def project(self, axis: int, columns: Floats) -> Floats:
        """Return the part of ``columns`` that the row's regressors explain, weights considered."""
        root = np.sqrt(self.weights)[:, None]
        design = self.design(axis)
        return np.asarray(design @ np.linalg.lstsq(design * root, columns * root, rcond=None)[0])

    def significance(self, axis: int) -> float:
        """Return by how many standard errors the row of T differs from zero."""
        gain = self.matrix[axis, : axis + 1]
        information = np.linalg.inv(self.covariances[axis][: axis + 1, : axis + 1])
        return float(np.sqrt(gain @ information @ gain))

    def own_significance(self, axis: int) -> float:
        """Return by how many standard errors the gain to the axis' own component differs from zero."""
        return float(abs(self.matrix[axis, axis]) / np.sqrt(self.covariances[axis][axis, axis]))


def fit_rows(h_nt: Floats, b_nt: Floats, z: Floats, weights: Floats, columns: tuple[int, int, int] = (1, 2, 3)) -> Rows:
    """Return the weighted least-squares rows: row i on the first ``columns[i]`` components of the field, 1 and z.

    Notes
    -----
    Centred and scaled columns, then QR: a field spread of 1e-4 |B| costs no digits that it need not cost.
    """
    n, k = len(h_nt), z.shape[1]
    count = int(np.count_nonzero(weights > 0))
    total = float(weights.sum())
    root = np.sqrt(weights)
    matrix, bias, slopes, errors = np.zeros((3, 3)), np.zeros(3), np.zeros((k, 3)), np.zeros((n, 3))
    sigma, covariances = np.zeros(3), []
    for axis in range(3):
        wide = columns[axis]
        raw = np.column_stack([b_nt[:, :wide], z])
        centre = weights @ raw / total
        spread = np.sqrt(weights @ (raw - centre) ** 2 / total)
        middle = float(weights @ h_nt[:, axis] / total)
        q, r = np.linalg.qr((raw - centre) / spread * root[:, None])
        solution = np.linalg.solve(r, q.T @ ((h_nt[:, axis] - middle) * root)) / spread
        matrix[axis, :wide], slopes[:, axis] = solution[:wide], solution[wide:]
        bias[axis] = middle - centre @ solution
        errors[:, axis] = (h_nt[:, axis] - middle) - (raw - centre) @ solution
        noise = float(np.sum(weights * errors[:, axis] ** 2) / (count - wide - 1 - k))
        sigma[axis] = max(np.sqrt(noise), 1e-13 * float(np.abs(h_nt[:, axis]).max()), 1e-300)
        half = np.linalg.inv(r) / spread[:, None]
        slope_covariance = half @ half.T * sigma[axis] ** 2
        covariances.append(_with_bias(slope_covariance, centre, sigma[axis] ** 2 / total, wide))
    triple = (covariances[0], covariances[1], covariances[2])
    return Rows(b_nt, z, matrix, bias, slopes, errors, sigma, weights, triple)


def _with_bias(covariance: Floats, centre: Floats, mean_variance: float, wide: int) -> Floats:
    """Return the covariance of (gains, bias, slopes) from that of (gains, slopes) about the centre."""
    size = len(centre)
    out = np.zeros((size + 1, size + 1))
    at = [*range(wide), *range(wide + 1, size + 1)]
    out[np.ix_(at, at)] = covariance
    out[wide, at] = out[at, wide] = -covariance @ centre
    out[wide, wide] = mean_variance + centre @ covariance @ centre
    return out


def reweighted(  # noqa: PLR0917
    h_nt: Floats, b_nt: Floats, z: Floats, prior: Floats, robust: str, near: Rows | None = None
) -> Rows:
    """Return the rows under a robust loss: the worst of a sample's three residuals decides its weight.

    The convex soft-L1 loss goes first, so that a redescending loss starts next to the right minimum; not so where
    ``near`` is given, the rows under that loss from nearly the same data.
    """
    if robust == "none":
        return fit_rows(h_nt, b_nt, z, prior)
    rows = fit_rows(h_nt, b_nt, z, prior if near is None else near.weights)
    used, floor = prior > 0, 1e-12 * float(np.abs(h_nt).max())
    for name in dict.fromkeys(("soft_l1", robust) if near is None else (robust,)):
        worst, previous, rounds, is_converged = _worst(rows, used, floor), rows, 0, False
        while rounds < _ROUNDS and not is_converged:
            weight, slope = weights_and_slopes(worst, name, 1.0)
            rows = fit_rows(h_nt, b_nt, z, prior * weight)
            worst = _worst(rows, used, floor)
            moved = np.abs(rows.residuals_nt - previous.residuals_nt).max()
            is_converged = bool(moved <= 1e-9 * rows.sigma_nt.max())
            previous, rounds = rows, rounds + 1
    # sum(psi') counts the worst residual's slope for the sample: exact where one residual decides, safe elsewhere.
    share = float(np.sum(prior * weight) / max(np.sum(prior * slope), 0.05 * np.sum(prior)))
    psi = np.array([np.sum(prior * (weight * rows.residuals_nt[:, i]) ** 2) for i in range(3)])
    plain = np.array([np.sum(prior * weight * rows.residuals_nt[:, i] ** 2) for i in range(3)])
    mean_weight = float(np.sum(prior * weight) / np.sum(prior))
    softening = share**2 / mean_weight * float(np.mean(psi / np.maximum(plain, 1e-300)))
    return Rows(
        b_nt, z, rows.matrix, rows.bias_nt, rows.slopes_nt, rows.residuals_nt, rows.sigma_nt, rows.weights,
        rows.covariances, softening, share, rounds, is_converged,
    )  # fmt: skip


def _worst(rows: Rows, used: NDArray[np.bool_], floor: float) -> Floats:
    """Return each sample's largest residual in units of its axis' robust noise."""
    scales = [robust_sigma(rows.residuals_nt[used, axis], floor) for axis in range(3)]
    return np.asarray(np.abs(rows.residuals_nt / scales).max(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class FullMatrix:
    """The twelve-parameter fit: T with all nine elements, and the test that the three above the diagonal are zero."""

    matrix: Floats
    f_statistic: float
    p_value: float
    lower: Floats
    rotation: Floats
    is_regular: bool

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation between the reference's frame and the magnetometer's base frame, deg."""
        proper = self.rotation * np.sign(np.linalg.det(self.rotation))
        return float(np.rad2deg(np.arccos(np.clip((np.trace(proper) - 1.0) / 2.0, -1.0, 1.0))))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Say that the reference is not in the sensor's own base frame, where the test finds so."""
        if self.p_value >= MISALIGNED_P or self.angle_deg < MISALIGNED_DEG:
            return ()
        return (
            f"misaligned: the reference is turned by {self.angle_deg:.2f} deg from the sensor's base frame "
            f"(p = {self.p_value:.1g}); full_matrix has the rotation",
        )

    def to_dict(self) -> dict[str, object]:
        """Return the fit as the records have it."""
        return {
            "matrix": self.matrix.tolist(),
            "f_statistic": self.f_statistic,
            "p_value": self.p_value,
            "lower_triangular": self.lower.tolist(),
            "rotation": self.rotation.tolist(),
            "rotation_deg": self.angle_deg,
        }


def full_rows(rows: Rows, observations: Observations, z: Standardised) -> FullMatrix:
    """Return the twelve-parameter fit with the weights of ``rows`` and the F-test of T12 = T13 = T23 = 0."""
    from scipy.special import fdtrc

    full = fit_rows(observations.h_nt, rows.b_nt, z.columns, rows.weights, (3, 3, 3))
    dof = int(np.count_nonzero(rows.weights > 0)) - 4 - len(z.names)
    gain = np.sum(rows.weights[:, None] * (rows.residuals_nt**2 - full.residuals_nt**2), axis=0)
    f_statistic = max(float(np.sum(gain / full.sigma_nt**2) / 3.0), 0.0)
    lower, rotation = lower_triangular_gauge(full.matrix)
    # Regular: the smallest gain in any direction is many times its error.
    error = max(float(np.sqrt(np.trace(full.covariances[axis][:3, :3]))) for axis in range(3))
    is_regular = bool(np.linalg.svd(full.matrix, compute_uv=False)[2] > 10.0 * error)
    p_value = float(fdtrc(3, 3 * max(dof, 1), f_statistic))
    return FullMatrix(full.matrix, f_statistic, p_value, lower, rotation, is_regular)

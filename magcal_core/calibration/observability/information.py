"""How well the samples determine the parameters, and which ones they cannot tell apart."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.linear_algebra import unit_diagonal
from magcal_core.numerics.products import products_of
from magcal_core.numerics.sphere import even_directions
from magcal_core.numerics.vectors import lengths
from magcal_core.sensor.model import inverse_lower
from magcal_core.sensor.parameterisation import matrix_jacobian
from magcal_core.sensor.parameters import SENSOR_NAMES

UNOBSERVABLE_BELOW: Final = 3.0
WEAK_BELOW: Final = 10.0
"""The index is a signal-to-noise ratio per sample of the weakest direction: below 3 noise fakes the excitation."""
NOISE_ALONE_BELOW: Final = 1.5
"""Noise-safe index that noise alone can reach: measured at most 0.7 where the samples determine nothing."""
ENOUGH: Final = 20_000
"""Samples, evenly spaced, that show what all of them determine."""
SIGMA_FLOOR: Final = 1e-7
"""Smallest noise that is believed, as a share of the field: 4 pT at 40 uT, and the rounding of the moments."""
PARAMETER_NAMES: Final = SENSOR_NAMES
SHORT_NAMES: Final = ("b1", "b2", "b3", "k1", "k2", "k3", "e1", "e2", "e3")

_QUADRATIC: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_ROOT2: Final = np.sqrt(2.0)
_REACH_DEG: Final = 15.0
_CELLS_PER_UNIT: Final = 50.0
_CELLS: Final = 101


@dataclass(frozen=True, slots=True, eq=False)
class ScalarInformation:
    """What the samples say of the nine parameters, free of any gauge.

    Attributes
    ----------
    index : float
        Smallest singular value per root n of [u_i u_j |x|/B, u_i] over (sigma/B): u the direction of the corrected
        reading x, B the mean field.
    noise_safe_index : float
        The same ratio with the part that noise itself contributes taken away, in the direction where it is smallest; it
        does not depend on the estimate's own scale, so that a parameter that ran away cannot feign excitation.
    weak : shape (m, 9)
        Directions below `WEAK_BELOW`, weakest first, as changes of (b / B, k / k, e in rad).
    ratios : shape (m,)
        Their indices.
    """

    index: float
    noise_safe_index: float
    weak: Floats
    ratios: Floats

    @property
    def is_observable(self) -> bool:
        """Whether the samples determine all nine parameters above the noise."""
        return self.index >= UNOBSERVABLE_BELOW and self.noise_safe_index >= NOISE_ALONE_BELOW


def scalar_information(x_nt: Floats, matrix: Floats, noise_nt: float) -> ScalarInformation:
    """Return what corrected readings ``x_nt``, shape (n, 3), nT, determine of a sensor with ``matrix`` T.

    ``noise_nt`` is the robust noise of one component of the reading, nT.

    Notes
    -----
    The nine parameters are observable where no x^T E x + f^T x vanishes on all samples (`docs/calibration.md`). Noise
    m in x makes such a form (2 E x + f).m; both moments are taken over the samples and compared.
    """
    x_nt = x_nt[:: max(1, len(x_nt) // ENOUGH)]
    mean_nt = float(np.mean(lengths(x_nt)))
    lower = inverse_lower(matrix)
    plain, signal, noise = _moments(x_nt / mean_nt, lower)
    share = max(noise_nt / mean_nt, SIGMA_FLOOR)
    values, vectors = np.linalg.eigh(plain)
    indices = np.sqrt(np.maximum(values, 0.0)) / share
    ratios, hidden = _generalised(signal, noise * share**2)
    safe = np.sqrt(np.maximum(ratios - 1.0, 0.0))
    if indices[0] >= UNOBSERVABLE_BELOW and safe[0] < NOISE_ALONE_BELOW:
        indices, vectors = safe, hidden
    is_weak = indices < WEAK_BELOW
    weak = np.array([_as_parameters(v, matrix, lower) for v in vectors.T[is_weak]]).reshape(-1, 9)
    return ScalarInformation(float(indices[0]), float(safe[0]), weak, indices[is_weak])


def _moments(x: Floats, lower: Floats) -> tuple[Floats, Floats, Floats]:
    """Return, per sample: moments of the unit design, of the polynomials (x^T E x, f^T x), and of their noise."""
    rows = np.empty((10, len(x)))
    rows[6:9], rows[9] = x.T, 1.0
    for k, (i, j) in enumerate(_QUADRATIC):
        np.multiply(rows[6 + i], rows[6 + j], out=rows[k])
    rows[3:6] *= _ROOT2
    unit = rows / np.sqrt(rows[0] + rows[1] + rows[2])
    moments, plain = products_of(rows) / len(x), products_of(unit) / len(x)
    noise = np.zeros((9, 9))
    for axis in range(3):
        slopes = _slopes(lower[:, axis])
        noise += slopes @ moments[6:, 6:] @ slopes.T
    return plain[:9, :9], moments[:9, :9], noise


def _slopes(direction: Floats) -> Floats:
    """Return the derivative of each polynomial along ``direction``, in terms of (x1, x2, x3, 1), shape (9, 4)."""
    slopes = np.zeros((9, 4))
    for k, (i, j) in enumerate(_QUADRATIC):
        factor = 1.0 if i == j else _ROOT2
        slopes[k, i] += factor * direction[j]
        slopes[k, j] += factor * direction[i]
    slopes[6:, 3] = direction
    return slopes


def _generalised(signal: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Return the ratios signal / noise, ascending, and their directions as columns."""
    values, vectors = np.linalg.eigh(noise)
    whitener = vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    ratios, inner = np.linalg.eigh(whitener.T @ signal @ whitener)
    return ratios, whitener @ inner


def _as_parameters(v: Floats, matrix: Floats, lower: Floats) -> Floats:
    """Return the change of (b / B, k / k, e) that the form (E, f) stands for, of unit length.

    Notes
    -----
    2 |x| dr = x^T E x + f^T x with E the symmetric part of K = dL T and f = -L db; K is lower triangular, dT = -T K.
    """
    k = np.zeros((3, 3))
    for value, (i, j) in zip(v[:6], _QUADRATIC, strict=True):
        k[j, i] = value if i == j else _ROOT2 * value
    change = (-matrix @ k)[np.tril_indices(3)]
    inner = matrix_jacobian(matrix) @ change
    inner[:3] /= np.linalg.norm(matrix, axis=1)
    direction = np.concatenate([-matrix @ v[6:], inner])
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-300))


def vector_information(b_nt: Floats, noise_nt: float) -> tuple[float, Floats, Floats]:
    """Return the index of the vector methods and the field's weakest direction: (index, spreads, directions).

    ``b_nt``: field in the base frame, shape (n, 3), nT; ``noise_nt``: noise of a component of the reading, nT. The
    index is the smallest spread of the field, over all directions, in units of the noise; ``spreads``, shape (3,), as
    shares of the mean field, ascending; ``directions``, shape (3, 3), as columns.
    """
    mean_nt = float(np.mean(np.linalg.norm(b_nt, axis=1)))
    centred = (b_nt - b_nt.mean(axis=0)) / mean_nt
    values, directions = np.linalg.eigh(centred.T @ centred / len(b_nt))
    spreads = np.sqrt(np.maximum(values, 0.0))
    return float(spreads[0]) / max(noise_nt / mean_nt, SIGMA_FLOOR), spreads, directions


def taking_part(directions: Floats, share: float = 0.3) -> tuple[int, ...]:
    """Return the parameters, as positions in `PARAMETER_NAMES`, that make up ``directions``, shape (m, 9)."""
    if not len(directions):
        return ()
    largest = np.abs(directions).max(axis=1, keepdims=True)
    return tuple(int(i) for i in np.flatnonzero((np.abs(directions) >= share * largest).any(axis=0)))


def condition_number(normal: Floats) -> float:
    """Return the condition number of a Jacobian with unit columns, from its normal matrix."""
    values = np.linalg.eigvalsh(unit_diagonal(normal)[0])
    return float(np.sqrt(values[-1] / max(values[0], 1e-16 * values[-1])))


@dataclass(frozen=True, slots=True, eq=False)
class SphereMotion:
    """Where the directions of the field went, unit vectors in the sensor's frame.

    Attributes
    ----------
    centre : shape (3,)
        Their mean.
    spreads : shape (3,)
        Their root mean square distance from it along the principal axes, ascending.
    axes : shape (3, 3)
        The principal axes, as columns.
    coverage : float
        Share of the sphere within `_REACH_DEG` of one of them.
    """

    centre: Floats
    spreads: Floats
    axes: Floats
    coverage: float


def sphere_motion(vectors: Floats, weights: Floats, bias: Floats, lower: Floats) -> SphereMotion:
    """Return where ``lower`` (v - ``bias``) pointed, v those of ``vectors``, shape (n, 3), that have weight."""
    cells = np.empty((min(len(vectors), _CELLS**3), 3))
    origin, total, products = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    v, w, b, m = (np.require(each, np.float64, ["C", "W"]) for each in (vectors, weights, bias, lower))
    seen = np.zeros(_CELLS**3, np.bool_)
    count, marked = _sweep(v, w, b, m, seen, cells, origin, total, products)
    mean = total / max(count, 1)
    values, axes = np.linalg.eigh(products / max(count, 1) - np.outer(mean, mean))
    return SphereMotion(origin + mean, np.sqrt(np.maximum(values, 0.0)), axes, _share_near(cells[:marked]))


def sphere_coverage(directions: Floats) -> float:
    """Return the share of the sphere within `_REACH_DEG` of one of ``directions``, unit vectors, shape (n, 3)."""
    return sphere_motion(directions, np.ones(len(directions)), np.zeros(3), np.eye(3)).coverage


def _share_near(cells: Floats) -> float:
    grid = even_directions(600)
    near = np.zeros(len(grid), dtype=bool)
    _mark_near(grid, cells, float(np.cos(np.deg2rad(_REACH_DEG))), near)
    return float(near.mean())


@kernel(error_model="numpy")
def _sweep(  # noqa: PLR0917
    vectors: Floats,
    weights: Floats,
    bias: Floats,
    lower: Floats,
    seen: NDArray[np.bool_],
    cells: Floats,
    origin: Floats,
    total: Floats,
    products: Floats,
) -> tuple[int, int]:  # pragma: no cover - compiled
    """Return the numbers of directions and of ``cells``; ``total`` and ``products`` are taken about ``origin``.

    Directions a degree apart cover the same: one of each is enough, and a million cost as little as a thousand.
    """
    count, marked = 0, 0
    for i in range(len(vectors)):
        d1, d2, d3 = vectors[i, 0] - bias[0], vectors[i, 1] - bias[1], vectors[i, 2] - bias[2]
        x = lower[0, 0] * d1
        y = lower[1, 0] * d1 + lower[1, 1] * d2
        z = lower[2, 0] * d1 + lower[2, 1] * d2 + lower[2, 2] * d3
        size = math.sqrt(x * x + y * y + z * z)
        if not (weights[i] > 0.0 and 0.0 < size < np.inf):
            continue
        x, y, z = x / size, y / size, z / size
        if not count:
            origin[0], origin[1], origin[2] = x, y, z
        count += 1
        d1, d2, d3 = x - origin[0], y - origin[1], z - origin[2]
        total[0] += d1
        total[1] += d2
        total[2] += d3
        products[0, 0] += d1 * d1
        products[1, 0] += d2 * d1
        products[1, 1] += d2 * d2
        products[2, 0] += d3 * d1
        products[2, 1] += d3 * d2
        products[2, 2] += d3 * d3
        x, y, z = np.rint(x * _CELLS_PER_UNIT), np.rint(y * _CELLS_PER_UNIT), np.rint(z * _CELLS_PER_UNIT)
        cell = int(((x + _CELLS_PER_UNIT) * _CELLS + y + _CELLS_PER_UNIT) * _CELLS + z + _CELLS_PER_UNIT)
        if not seen[cell]:
            seen[cell] = True
            size = max(math.sqrt(x * x + y * y + z * z), 1e-12)
            cells[marked, 0], cells[marked, 1], cells[marked, 2] = x / size, y / size, z / size
            marked += 1
    return count, marked


@kernel()
def _mark_near(
    grid: Floats, cells: Floats, cosine: float, near: NDArray[np.bool_]
) -> None:  # pragma: no cover - compiled
    """Mark the ``grid`` vectors that have one of ``cells`` within the angle of this ``cosine``."""
    for k in range(len(grid)):
        for i in range(len(cells)):
            if grid[k, 0] * cells[i, 0] + grid[k, 1] * cells[i, 1] + grid[k, 2] * cells[i, 2] >= cosine:
                near[k] = True
                break


@dataclass(frozen=True, slots=True)
class Observability:
    """How well the samples determine the parameters (`docs/references.md`: magcal-observability)."""

    index: float
    condition_number: float
    sphere_coverage: float
    weak_directions: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the figures as the records of the service have them."""
        return {
            "index": self.index,
            "condition_number": self.condition_number,
            "sphere_coverage": self.sphere_coverage,
            "weak_directions": list(self.weak_directions),
        }

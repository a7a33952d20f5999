"""A start that half of the rows may be wrong for: least trimmed squares of the quadric, or of the vector rows.

Notes
-----
Row i of the quadric h^T A h - 2 c^T h + d = B^2, ten unknowns, has the weight 1 / (2 B), so that its residual is that
of |x| - B. Subsets are small and simple (one scale factor: five unknowns), because a subset serves only where all its
rows are good: of 30 % wrong rows, 0.7^6 = 12 % of the subsets of six are, and 1.4 % of those of twelve.
P. Rousseeuw, K. Van Driessen: Computing LTS regression for large data sets. Data Min. Knowl. Discov. 12 (2006).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.scalar_start import start_of_quadric
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.linear_algebra import solve_positive
from magcal_core.numerics.medians import median_in_place
from magcal_core.numerics.vectors import lengths
from magcal_core.sensor.correction import corrected_lengths
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows, rows_from_theta
from magcal_core.sensor.parameters import Parameters

ROWS: Final = 500
"""Rows that are looked at, one drawn from each of so many equal stretches of the session."""
SUBSETS: Final = 160
FEW_SUBSETS: Final = 20
"""Subsets where many references are compared with each other."""
SUBSET_ROWS: Final = 6
SEED: Final = 20220219
_BEST: Final = 10
_ROUNDS: Final = 20
_STILL: Final = 1e-6
_WITHIN: Final = 4.0
"""Scales within which a row counts for the last rounds."""
_RIDGE: Final = 1e-9
_FINE_RIDGE: Final = 1e-10
_GAUSSIAN_MAD: Final = 1.4826
_SINGULAR: Final = 1e-16
"""Pivot, of a matrix of unit diagonal, that is none."""
_UNKNOWNS: Final = 10
_VECTOR_ROWS: Final = 5
_NONE: Final = Standardised((), np.zeros((0, 0)), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class RobustStart:
    """Where a robust loss begins.

    Attributes
    ----------
    parameters : Parameters, optional
        The sensor that the good rows show; None for the vector methods, which begin at weights.
    scale_nt : float
        Scale of the good rows' residuals, nT.
    weights : shape (n,)
        1 for rows within four scales, else 0.
    """

    parameters: Parameters | None
    scale_nt: float
    weights: Floats


@kernel()
def _scale_of(size: Floats) -> float:  # pragma: no cover - compiled
    """Return the scale of absolute residuals: their median, then that of those within five scales, until it stands."""
    n = size.size
    inside = np.empty(n)
    for i in range(n):
        if math.isnan(size[i]):
            return math.nan
        inside[i] = size[i]
    scale = _GAUSSIAN_MAD * median_in_place(inside, 0, n)
    for _ in range(50):
        count = 0
        for i in range(n):
            if size[i] < 5.0 * scale:
                inside[count] = size[i]
                count += 1
        if count == 0:
            return scale
        narrower = _GAUSSIAN_MAD * median_in_place(inside[:count], 0, count)
        if abs(narrower - scale) <= 1e-3 * scale:
            return narrower
        scale = narrower
    return scale


def scale_of(residuals: Floats) -> float:
    """Return the robust scale of ``residuals``, any shape, in their unit.

    Notes
    -----
    1.4826 median |r|, then the same over |r| < 5 s until it changes by less than a thousandth.
    """
    size = np.abs(residuals).ravel()
    return float(_scale_of(size)) if size.size else 0.0


@kernel()
def _fit_rows(
    rows: Floats, target: Floats, keep: NDArray[np.bool_], ridge: float, out: Floats
) -> bool:  # pragma: no cover - compiled
    """Leave the least-squares solution of the rows to ``keep`` in ``out``."""
    p = rows.shape[1]
    normal, right = np.zeros((p, p)), np.zeros(p)
    for i in range(target.size):
        if not keep[i]:
            continue
        for j in range(p):
            value = rows[i, j]
            right[j] += value * target[i]
            for k in range(j, p):
                normal[j, k] += value * rows[i, k]
    for j in range(p):
        for k in range(j):
            normal[j, k] = normal[k, j]
    return bool(solve_positive(normal, right, ridge, _SINGULAR, out))


@kernel()
def _sizes(rows: Floats, target: Floats, p: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(target.size):
        total = -target[i]
        for j in range(p.size):
            total += rows[i, j] * p[j]
        out[i] = abs(total)


@kernel()
def _concentrate(  # noqa: PLR0917
    rows: Floats, target: Floats, p: Floats, count: int, size: Floats, keep: NDArray[np.bool_]
) -> float:  # pragma: no cover - compiled
    """Keep the ``count`` rows of least residual, solve again in ``p``, and return their root mean square there."""
    limit = np.partition(size, count - 1)[count - 1]
    for i in range(size.size):
        keep[i] = size[i] <= limit
    if not _fit_rows(rows, target, keep, _FINE_RIDGE, p):
        return np.inf
    _sizes(rows, target, p, size)
    kept = np.partition(size, count - 1)[:count]
    return float(np.sqrt(np.sum(kept * kept) / count))


@kernel()
def _search(  # noqa: PLR0912, PLR0917 - one straight search
    rows: Floats, target: Floats, simple: Floats, carry: NDArray[np.int64], subsets: NDArray[np.int64], count: int
) -> Floats:  # pragma: no cover - compiled
    """Return the best solutions, best first, shape (m, p + 1), the trimmed root mean square last.

    ``simple``: rows of the simpler model that subsets are fitted by; its unknown ``carry[j]`` stands for unknown j of
    the whole model, -1 for none.
    """
    n, p = rows.shape
    starts = subsets.shape[0] + 1
    found = np.full((starts, p + 1), np.inf)
    size, keep = np.empty(n), np.zeros(n, dtype=np.bool_)
    few, whole = np.empty(simple.shape[1]), np.empty(p)
    for s in range(starts):
        if s < subsets.shape[0]:
            keep[:] = False
            for i in subsets[s]:
                keep[i] = True
            if not _fit_rows(simple, target, keep, _RIDGE, few):
                continue
            for j in range(p):
                whole[j] = few[carry[j]] if carry[j] >= 0 else 0.0
        else:
            keep[:] = True
            if not _fit_rows(rows, target, keep, _FINE_RIDGE, whole):
                continue
        _sizes(rows, target, whole, size)
        spread = np.inf
        for _ in range(2):
            spread = _concentrate(rows, target, whole, count, size, keep)
            if not np.isfinite(spread):
                break
        found[s, :p], found[s, p] = whole, spread
    order = np.argsort(found[:, p])
    best = found[order[: min(_BEST, starts)]].copy()
    for s in range(best.shape[0]):
        if not np.isfinite(best[s, p]):
            continue
        whole[:] = best[s, :p]
        spread = best[s, p]
        _sizes(rows, target, whole, size)
        for _ in range(_ROUNDS):
            narrower = _concentrate(rows, target, whole, count, size, keep)
            if not narrower < spread * (1.0 - _STILL):
                break
            spread = narrower
            best[s, :p], best[s, p] = whole, spread
    return best[np.argsort(best[:, p])]


@kernel()
def _polished(rows: Floats, target: Floats, p: Floats) -> float:  # pragma: no cover - compiled
    """Leave what the rows within four scales ask for in ``p``, five times over; return the scale."""
    size, keep = np.empty(target.size), np.empty(target.size, dtype=np.bool_)
    trial = p.copy()
    for _ in range(5):
        _sizes(rows, target, p, size)
        scale = _scale_of(size)
        for i in range(size.size):
            keep[i] = size[i] < _WITHIN * scale
        if not _fit_rows(rows, target, keep, _FINE_RIDGE, trial):
            break
        p[:] = trial
    _sizes(rows, target, p, size)
    return float(_scale_of(size))


def rows_looked_at(n: int, count: int = ROWS) -> NDArray[np.intp]:
    """Return at most ``count`` of ``n`` rows, one drawn at random from each of as many equal stretches."""
    if n <= count:
        return np.arange(n, dtype=np.intp)
    edges = np.arange(count + 1) * n // count
    return np.asarray(np.random.default_rng(SEED).integers(edges[:-1], edges[1:]), np.intp)


def _subsets(n: int, count: int, size: int) -> NDArray[np.int64]:
    random = np.random.default_rng(SEED)
    return np.argpartition(random.random((count, n)), size, axis=1)[:, :size].astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Quadric:
    """Readings as rows of the quadric, over ``unit_nt``; the field may be another one each time."""

    squares: Floats
    subsets: NDArray[np.int64]
    unit_nt: float

    @classmethod
    def of(cls, h_nt: Floats, subsets: int = SUBSETS) -> Quadric:
        """Return the quadric of readings ``h_nt``, shape (n, 3), nT."""
        unit_nt = float(np.median(lengths(h_nt))) or 1.0
        x, y, z = (h_nt / unit_nt).T
        rows = np.column_stack(
            [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, -2 * x, -2 * y, -2 * z, np.ones(len(x))]
        )
        return cls(rows, _subsets(len(x), subsets, min(SUBSET_ROWS, len(x) - 1)), unit_nt)

    def fits(self, b_nt: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the best solutions, shape (m, 11), and rows and targets that they are of; ``b_nt``: shape (n,), nT."""
        b = b_nt / self.unit_nt
        rows = self.squares / (2.0 * b)[:, None]
        simple = np.column_stack([rows[:, :3].sum(axis=1), rows[:, 6:]])
        carry = np.array([0, 0, 0, -1, -1, -1, 1, 2, 3, 4])
        count = min(int(np.ceil((len(b) + _UNKNOWNS + 1) / 2)), len(b))
        return _search(rows, 0.5 * b, simple, carry, self.subsets, count), rows, 0.5 * b

    def scale_nt(self, b_nt: Floats) -> float:
        """Return the scale, nT, that least trimmed squares leave of ``b_nt``, shape (n,), nT."""
        found, rows, target = self.fits(b_nt)
        if not np.isfinite(found[0]).all():
            return float("inf")
        return _polished(rows, target, np.ascontiguousarray(found[0, :_UNKNOWNS])) * self.unit_nt

    def fit_residuals_nt(self, b_nt: Floats) -> tuple[Floats, float, Floats]:
        """Return the residuals, shape (n,), nT, about least trimmed squares, their scale, nT, and the ten unknowns."""
        found, rows, target = self.fits(b_nt)
        p = np.ascontiguousarray(found[0, :_UNKNOWNS])
        if not np.isfinite(found[0]).all():
            return np.full(len(b_nt), np.inf), float("inf"), p
        scale = _polished(rows, target, p)
        return (rows @ p - target) * self.unit_nt, scale * self.unit_nt, p


def scalar_start(h_nt: Floats, b_nt: Floats) -> RobustStart | None:
    """Return where a loss of |x| - B begins; None where the rows show no ellipsoid.

    ``h_nt``: readings, shape (n, 3), nT; ``b_nt``: field magnitudes, shape (n,), nT.
    """
    few = rows_looked_at(len(b_nt))
    quadric = Quadric.of(np.ascontiguousarray(h_nt[few]))
    found, rows, target = quadric.fits(np.ascontiguousarray(b_nt[few]))
    for one in found:
        if not np.isfinite(one).all():
            break
        p = np.ascontiguousarray(one[:_UNKNOWNS])
        _polished(rows, target, p)
        theta = start_of_quadric(p, None)
        if theta is None:
            continue
        theta = np.concatenate([theta[:6], theta[6:] * quadric.unit_nt])
        return _scalar_start_at(theta, h_nt, b_nt)
    return None


def _scalar_start_at(theta: Floats, h_nt: Floats, b_nt: Floats) -> RobustStart:
    matrix, bias_nt, slopes = rows_from_theta(theta, 0)
    lower = np.zeros((3, 3))
    lower[np.tril_indices(3)] = theta[:6]
    r = corrected_lengths(h_nt, bias_nt, lower) - b_nt
    scale_nt = max(scale_of(r), 1e-9 * float(np.median(b_nt)))
    parameters = parameters_from_rows(matrix, bias_nt, slopes, _NONE)
    return RobustStart(parameters, scale_nt, (np.abs(r) <= _WITHIN * scale_nt).astype(np.float64))


def vector_start(h_nt: Floats, b_base_nt: Floats) -> RobustStart | None:
    """Return where a loss of h - T B - b begins, T with all nine elements; None where no subset determines it.

    ``h_nt``, ``b_base_nt``: readings and the field in the base frame, shape (n, 3), nT.

    Notes
    -----
    Subsets of five rows, four unknowns an axis; the residual of a row is the length of its vector. A turned reference
    does not pass for bad rows, because T is whole.
    """
    few = rows_looked_at(len(h_nt))
    unit_nt = float(np.median(lengths(b_base_nt)))
    design = np.column_stack([b_base_nt[few] / unit_nt, np.ones(len(few))])
    target = np.ascontiguousarray(h_nt[few] / unit_nt)
    count = min(int(np.ceil((len(few) + 5) / 2)), len(few))
    subsets = _subsets(len(few), SUBSETS // 2, min(_VECTOR_ROWS, len(few) - 1))
    coefficients, is_found = _search_vectors(design, target, subsets, count)
    if not is_found:
        return None
    r = h_nt - unit_nt * (np.column_stack([b_base_nt / unit_nt, np.ones(len(h_nt))]) @ coefficients)
    floor = 1e-9 * unit_nt
    for _ in range(5):
        scales = np.array([max(scale_of(r[:, axis]), floor) for axis in range(3)])
        is_near = (np.abs(r) < _WITHIN * scales).all(axis=1)
        near = np.flatnonzero(is_near)
        if len(near) <= _VECTOR_ROWS:
            return None
        columns = np.column_stack([b_base_nt[near] / unit_nt, np.ones(len(near))])
        coefficients = np.asarray(np.linalg.lstsq(columns, h_nt[near] / unit_nt, rcond=1e-12)[0], np.float64)
        r = h_nt - unit_nt * (np.column_stack([b_base_nt / unit_nt, np.ones(len(h_nt))]) @ coefficients)
    scales = np.array([max(scale_of(r[:, axis]), floor) for axis in range(3)])
    weights = np.asarray((np.abs(r) < _WITHIN * scales).all(axis=1), np.float64)
    return RobustStart(None, float(np.sqrt(np.mean(scales**2))), weights)


@kernel()
def _fit_vectors(
    design: Floats, target: Floats, keep: NDArray[np.bool_], ridge: float, out: Floats
) -> bool:  # pragma: no cover - compiled
    p = design.shape[1]
    normal, right, one = np.zeros((p, p)), np.zeros((p, 3)), np.empty(p)
    for i in range(target.shape[0]):
        if not keep[i]:
            continue
        for j in range(p):
            for k in range(p):
                normal[j, k] += design[i, j] * design[i, k]
            for axis in range(3):
                right[j, axis] += design[i, j] * target[i, axis]
    for axis in range(3):
        if not solve_positive(normal, right[:, axis].copy(), ridge, _SINGULAR, one):
            return False
        out[:, axis] = one
    return True


@kernel()
def _vector_sizes(design: Floats, target: Floats, p: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(target.shape[0]):
        total = 0.0
        for axis in range(3):
            r = -target[i, axis]
            for j in range(p.shape[0]):
                r += design[i, j] * p[j, axis]
            total += r * r
        out[i] = np.sqrt(total)


@kernel()
def _search_vectors(
    design: Floats, target: Floats, subsets: NDArray[np.int64], count: int
) -> tuple[Floats, bool]:  # pragma: no cover - compiled
    """Return the coefficients of least trimmed squares, shape (4, 3), and whether any subset determined them."""
    n, p = design.shape
    best, least = np.zeros((p, 3)), np.inf
    size, keep, trial = np.empty(n), np.zeros(n, dtype=np.bool_), np.empty((p, 3))
    for s in range(subsets.shape[0] + 1):
        keep[:] = s == subsets.shape[0]
        if s < subsets.shape[0]:
            for i in subsets[s]:
                keep[i] = True
        if not _fit_vectors(design, target, keep, _RIDGE, trial):
            continue
        _vector_sizes(design, target, trial, size)
        spread = np.inf
        for k in range(_ROUNDS):
            limit = np.partition(size, count - 1)[count - 1]
            for i in range(n):
                keep[i] = size[i] <= limit
            if not _fit_vectors(design, target, keep, _FINE_RIDGE, trial):
                break
            _vector_sizes(design, target, trial, size)
            kept = np.partition(size, count - 1)[:count]
            narrower = np.sqrt(np.sum(kept * kept) / count)
            is_still = not narrower < spread * (1.0 - _STILL)
            spread = min(spread, narrower)
            # Two steps tell whether a start is worth more.
            if is_still or (k == 1 and spread > 1.5 * least):
                break
        if spread < least:
            least = spread
            best[:, :] = trial
    return best, bool(np.isfinite(least))

"""Iteratively reweighted regressions of three targets on shared columns, compiled: two passes over the data a round.

Notes
-----
Target i is regressed on the columns that ``takes`` gives it and on a constant, x = (columns - centre, 1). A round sums
N = sum w x x^T and g = sum w x e, e the residuals so far, and adds N^-1 g to the coefficients. Because it is the
residuals that are regressed, what rounding a round leaves is the next one's to take away: normal equations lose no
digits to a field of small spread that QR would keep. All arrays are C-contiguous float64.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import add_to, copy_into, has_weight, kernel
from magcal_core.numerics.linear_algebra import solve_positive
from magcal_core.numerics.medians import median_size
from magcal_core.numerics.products import FAST, add_products
from magcal_core.numerics.robust import LOSSES, TUNING, loss_of

_CHUNK: Final = 256
_TUNING: Final = np.array(TUNING)
_HUBER: Final = LOSSES["huber"]
_GAUSSIAN_MAD: Final = 1.4826
_SINGULAR: Final = 1e-15
_REFINEMENTS: Final = 5
_ROUNDING: Final = 1e-12


@kernel(fastmath=FAST, error_model="numpy")
def _sums(  # noqa: PLR0917
    columns: Floats,
    centre: Floats,
    residuals: Floats,
    weights: Floats,
    first: int,
    end: int,
    total: Floats,
) -> None:  # pragma: no cover - compiled
    """Leave the weighted moments of (columns - centre, 1, residuals) in ``total``, upper half, from some samples."""
    c = columns.shape[0]
    rows = np.zeros((c + 4 + c % 2, _CHUNK))
    root = np.empty(_CHUNK)
    total[:, :] = 0.0
    for start in range(first, end, _CHUNK):
        count = min(_CHUNK, end - start)
        weight = weights[start : start + count]
        if not has_weight(weight):
            continue
        for i in range(count):
            root[i] = math.sqrt(weight[i])
        for j in range(c):
            row, middle, column = rows[j], centre[j], columns[j][start : start + count]
            for i in range(count):
                row[i] = (column[i] - middle) * root[i]
        row = rows[c]
        for i in range(count):
            row[i] = root[i]
        for axis in range(3):
            row, error = rows[c + 1 + axis], residuals[axis][start : start + count]
            for i in range(count):
                row[i] = error[i] * root[i]
        add_products(rows, count, total)


@kernel(fastmath=FAST, error_model="numpy")
def _subtract(
    columns: Floats, centre: Floats, change: Floats, weights: Floats, residuals: Floats
) -> tuple[float, Floats]:  # pragma: no cover - compiled
    """Take ``change`` . (columns - centre, 1) off the residuals; return the largest change and sum w e^2 by axis."""
    c, n = columns.shape
    step, largest, squares = np.empty(_CHUNK), 0.0, np.zeros(3)
    for start in range(0, n, _CHUNK):
        count = min(_CHUNK, n - start)
        weight = weights[start : start + count]
        for axis in range(3):
            constant = change[axis, c]
            for j in range(c):
                constant -= change[axis, j] * centre[j]
            for i in range(count):
                step[i] = constant
            for j in range(c):
                slope, column = change[axis, j], columns[j][start : start + count]
                if slope != 0.0:
                    for i in range(count):
                        step[i] += slope * column[i]
            error = residuals[axis][start : start + count]
            size = 0.0
            for i in range(count):
                size = max(size, abs(step[i]))
            for i in range(count):
                error[i] -= step[i]
            square = 0.0
            for i in range(count):
                square += weight[i] * error[i] * error[i]
            largest = max(largest, size)
            squares[axis] += square
    return largest, squares


@kernel()
def _changes(total: Floats, takes: NDArray[np.bool_], change: Floats) -> bool:  # pragma: no cover - compiled
    """Leave what the moments add to the coefficients, shape (3, c + 1), in ``change``; False where singular."""
    c = takes.shape[1]
    change[:, :] = 0.0
    for axis in range(3):
        at = np.empty(c + 1, np.intp)
        p = 0
        for j in range(c):
            if takes[axis, j]:
                at[p] = j
                p += 1
        at[p] = c
        p += 1
        matrix, right, out = np.empty((p, p)), np.empty(p), np.empty(p)
        for i in range(p):
            for j in range(i, p):
                matrix[j, i] = total[at[i], at[j]]
            right[i] = total[at[i], c + 1 + axis]
        if not solve_positive(matrix, right, 0.0, _SINGULAR, out):
            return False
        for i in range(p):
            change[axis, at[i]] = out[i]
    return True


@kernel()
def regress(  # noqa: PLR0917
    columns: Floats,
    centre: Floats,
    takes: NDArray[np.bool_],
    weights: Floats,
    coefficients: Floats,
    residuals: Floats,
    total: Floats,
    squares: Floats,
) -> bool:  # pragma: no cover - compiled
    """Leave the weighted least-squares regressions in the last four arrays; False where they are not determined.

    ``columns``, shape (c, n). ``coefficients``, shape (3, c + 1), and ``residuals``, shape (3, n), fit each other on
    entry: zeros and the targets, or an estimate near. ``total``: moments, upper half; ``squares``: sum w e^2 of each
    target.
    """
    change = np.empty_like(coefficients)
    first = -1.0
    for _ in range(_REFINEMENTS):
        _sums(columns, centre, residuals, weights, 0, weights.size, total)
        if not _changes(total, takes, change):
            return False
        add_to(coefficients, change)
        moved, left = _subtract(columns, centre, change, weights, residuals)
        copy_into(squares, left)
        # The first step takes off the targets themselves; one or two more take off what its rounding left.
        if first >= 0.0 and moved <= _ROUNDING * first:
            break
        first = max(first, moved)
    return True


@kernel(fastmath=FAST, error_model="numpy")
def _weights_of_worst(
    residuals: Floats, scales: Floats, prior: Floats, loss: int, weights: Floats
) -> None:  # pragma: no cover - compiled
    """Leave prior times robust weight, which each sample's worst residual decides, in ``weights``."""
    bend = _TUNING[loss]
    s1, s2, s3 = 1.0 / (scales[0] * bend), 1.0 / (scales[1] * bend), 1.0 / (scales[2] * bend)
    e1, e2, e3 = residuals[0], residuals[1], residuals[2]
    for i in range(prior.size):
        weights[i] = max(abs(e1[i]) * s1, abs(e2[i]) * s2, abs(e3[i]) * s3)
    if loss == 2:
        for i in range(prior.size):
            weights[i] = prior[i] / math.sqrt(1.0 + weights[i] * weights[i])
        return
    for i in range(prior.size):
        weights[i] = prior[i] * loss_of(loss, weights[i] * weights[i])[1]


@kernel()
def regress_robustly(  # noqa: PLR0917
    columns: Floats,
    centre: Floats,
    takes: NDArray[np.bool_],
    prior: Floats,
    loss: int,
    floor: float,
    smallest: Floats,
    rounds: int,
    still: float,
    weights: Floats,
    coefficients: Floats,
    residuals: Floats,
    total: Floats,
    squares: Floats,
) -> int:  # pragma: no cover - compiled
    """Reweight and solve until the residuals stand still; return the rounds, negative if they are not enough.

    The last five arrays are those of `regress`, an estimate on entry and the robust one in the end, ``weights`` with
    it. ``floor``: smallest robust scale; ``smallest``: least standard deviation of each target; ``still``: movement of
    a residual, in units of the noise, that ends it. 0 where the regressions are not determined.
    """
    c, n = columns.shape
    change, scratch = np.empty_like(coefficients), np.empty(n)
    medians, reach = np.full(3, -1.0), np.full(3, 0.2)
    scales = np.empty(3)
    for done in range(1, rounds + 1):
        for axis in range(3):
            median = median_size(residuals[axis], prior, medians[axis], reach[axis], scratch)
            if medians[axis] > 0.0:
                reach[axis] = min(0.2, max(0.002, 4.0 * abs(median / medians[axis] - 1.0)))
            medians[axis] = median
            scales[axis] = max(_GAUSSIAN_MAD * median, floor)
        _weights_of_worst(residuals, scales, prior, loss, weights)
        _sums(columns, centre, residuals, weights, 0, weights.size, total)
        if not _changes(total, takes, change):
            return 0
        add_to(coefficients, change)
        moved, left = _subtract(columns, centre, change, weights, residuals)
        copy_into(squares, left)
        count = 0
        for i in range(n):
            if weights[i] > 0.0:
                count += 1
        noise = 0.0
        for axis in range(3):
            unknowns = 1
            for j in range(c):
                unknowns += takes[axis, j]
            noise = max(noise, math.sqrt(squares[axis] / max(count - unknowns, 1)), smallest[axis])
        if moved <= still * noise:
            return done
    return -rounds


@kernel()
def regress_affinely(  # noqa: PLR0917
    columns: Floats,
    centre: Floats,
    takes: NDArray[np.bool_],
    prior: Floats,
    floor: float,
    rounds: int,
    weights: Floats,
    coefficients: Floats,
    residuals: Floats,
    total: Floats,
    squares: Floats,
) -> bool:  # pragma: no cover - compiled
    """Solve ``rounds`` times under Huber's loss of a sample's whole residual; False where it is not determined.

    The last five arrays are those of `regress`; ``weights`` are in the end those that the last residuals ask for.
    """
    n = prior.size
    change, scratch, size = np.empty_like(coefficients), np.empty(n), np.empty(n)
    bend = _TUNING[_HUBER]
    median = -1.0
    for done in range(rounds):
        # The first solution takes off the targets themselves: solved twice, for what its rounding leaves.
        for _ in range(2 if done == 0 else 1):
            _sums(columns, centre, residuals, weights, 0, n, total)
            if not _changes(total, takes, change):
                return False
            add_to(coefficients, change)
            copy_into(squares, _subtract(columns, centre, change, weights, residuals)[1])
        e1, e2, e3 = residuals[0], residuals[1], residuals[2]
        for i in range(n):
            size[i] = math.sqrt(e1[i] * e1[i] + e2[i] * e2[i] + e3[i] * e3[i])
        median = median_size(size, prior, median, 0.05, scratch)
        scale = max(_GAUSSIAN_MAD * median, floor) * bend
        for i in range(n):
            weights[i] = prior[i] * loss_of(_HUBER, (size[i] / scale) ** 2)[1]
    return True


@kernel()
def sums_of_blocks(  # noqa: PLR0917
    columns: Floats, centre: Floats, residuals: Floats, weights: Floats, starts: NDArray[np.intp], totals: Floats
) -> None:  # pragma: no cover - compiled
    """Leave the weighted moments of (columns - centre, 1, residuals) of each block in ``totals``, both halves."""
    for block in range(starts.size):
        end = starts[block + 1] if block + 1 < starts.size else weights.size
        total = totals[block]
        _sums(columns, centre, residuals, weights, starts[block], end, total)
        for i in range(total.shape[0]):
            for j in range(i):
                total[i, j] = total[j, i]


def room_for(columns: int) -> int:
    """Return the width of a moments array for that many columns: with the constant and three residuals, and even."""
    return columns + 4 + columns % 2

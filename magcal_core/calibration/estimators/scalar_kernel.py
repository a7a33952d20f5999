"""The scalar fit's pass over the data: cost, gradient and normal matrix, accumulated chunk by chunk.

Notes
-----
The unknowns are those in which the corrected reading x = L (h - b) is linear:
``theta = (L11, L21, L22, L31, L32, L33, c1, c2, c3, d_11..d_K3, tau_1..tau_M)`` with c = L b, d_j = L (coefficients of
regressor j) and x = L h - c - sum_j d_j z_j. The residual of one sample is |x| - (B - sum_m tau_m B'_m), B' the rates
of the reference (``rate``). With u = x/|x| its gradient is u_i h_j to L_ij, -u to c, -u z_j to d_j and B'_m to tau_m.

With a noise of sigma in each component of h the *geometric* residual is (|x| - B - beta)/|g|, g = L^T u,
beta = sigma^2 (tr L L^T - |g|^2) / (2 |x|): its mean is zero and its variance sigma^2, so that noise biases nothing
(`docs/calibration.md`, noise). All arrays are C-contiguous float64.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import has_weight, kernel
from magcal_core.numerics.products import FAST, add_products
from magcal_core.numerics.robust import loss_of, slope_of

_LEAST_SLOPE: Final = 1.0 / 64.0
"""Share of psi / r that Newton's matrix keeps where psi' is less: it stays positive."""
_CHUNK: Final = 256


@kernel(fastmath=FAST, error_model="numpy")
def _weigh(  # noqa: PLR0912, PLR0917
    r: Floats, weight: Floats, loss: int, bend: float, is_newton: bool, root: Floats, last: Floats
) -> float:  # pragma: no cover - compiled
    """Return the cost of the residuals ``r``; leave what multiplies each row in ``root``, and its residual in ``last``.

    The product of both is the weighted residual; the square of ``root`` is the whole weight, or with ``is_newton`` the
    weight by psi'.
    """
    cost = 0.0
    if loss == 0:
        for i in range(r.size):
            cost += weight[i] * r[i] * r[i]
        for i in range(r.size):
            root[i] = math.sqrt(weight[i])
        for i in range(r.size):
            last[i] = root[i] * r[i]
        return cost
    inverse = 1.0 / bend
    if loss == 2:
        for i in range(r.size):
            s = r[i] * inverse
            root[i] = math.sqrt(1.0 + s * s)
        for i in range(r.size):
            cost += weight[i] * 2.0 * (root[i] - 1.0)
        if is_newton:
            for i in range(r.size):
                last[i] = r[i] * math.sqrt(weight[i] * root[i])
            for i in range(r.size):
                root[i] = math.sqrt(weight[i] / (root[i] * root[i] * root[i]))
            return cost * bend * bend
        for i in range(r.size):
            root[i] = math.sqrt(weight[i] / root[i])
        for i in range(r.size):
            last[i] = root[i] * r[i]
        return cost * bend * bend
    for i in range(r.size):
        s = r[i] * inverse
        rho, w = loss_of(loss, s * s)
        cost += weight[i] * rho
        steep = max(slope_of(loss, s * s), _LEAST_SLOPE * w) if is_newton else w
        root[i] = math.sqrt(steep * weight[i])
        last[i] = r[i] * w * math.sqrt(weight[i] / steep) if steep > 0.0 else 0.0
    return cost * bend * bend


@kernel(fastmath=FAST, error_model="numpy")
def _geometric(  # noqa: PLR0917
    theta: Floats, sigma: float, length: Floats, r: Floats, u: Floats, extra: Floats, inverse: Floats
) -> None:  # pragma: no cover - compiled
    """Turn the residual into the geometric one and its gradient's factors of h; ``extra``: what L adds beside them."""
    l11, l21, l22 = theta[0], theta[1], theta[2]
    l31, l32, l33 = theta[3], theta[4], theta[5]
    s11, s12, s13 = l11 * l11, l11 * l21, l11 * l31
    s22, s23, s33 = l21 * l21 + l22 * l22, l21 * l31 + l22 * l32, l31 * l31 + l32 * l32 + l33 * l33
    trace = s11 + s22 + s33
    for i in range(r.size):
        u1, u2, u3 = u[0, i], u[1, i], u[2, i]
        v1 = s11 * u1 + s12 * u2 + s13 * u3
        v2 = s12 * u1 + s22 * u2 + s23 * u3
        v3 = s13 * u1 + s23 * u2 + s33 * u3
        q = u1 * v1 + u2 * v2 + u3 * v3
        over = 1.0 / math.sqrt(q)
        half = sigma * sigma / (2.0 * length[i])
        beta = half * (trace - q)
        residual = (r[i] - beta) * over
        kappa = half * over - 0.5 * residual / q
        turn = 2.0 * kappa / length[i]
        along = (1.0 + beta / length[i]) * over - turn * q
        g1 = l11 * u1 + l21 * u2 + l31 * u3
        g2, g3 = l22 * u2 + l32 * u3, l33 * u3
        f, e = 2.0 * kappa, 2.0 * half * over
        extra[0, i] = f * u1 * g1 - e * l11
        extra[1, i] = f * u2 * g1 - e * l21
        extra[2, i] = f * u2 * g2 - e * l22
        extra[3, i] = f * u3 * g1 - e * l31
        extra[4, i] = f * u3 * g2 - e * l32
        extra[5, i] = f * u3 * g3 - e * l33
        u[0, i] = along * u1 + turn * v1
        u[1, i] = along * u2 + turn * v2
        u[2, i] = along * u3 + turn * v3
        r[i] = residual
        inverse[i] = over


@kernel(fastmath=FAST, error_model="numpy")
def accumulate(  # noqa: PLR0912, PLR0915, PLR0917 - one straight derivation
    h: Floats,
    b: Floats,
    weight: Floats,
    z: Floats,
    rate: Floats,
    theta: Floats,
    loss: int,
    bend: float,
    sigma: float,
    is_newton: bool,
    normal: Floats,
    gradient: Floats,
) -> float:  # pragma: no cover - compiled
    """Return the cost at ``theta`` and leave J^T W J in ``normal`` and J^T W r in ``gradient``.

    ``bend`` is the residual, nT, at which ``loss`` bends; ``sigma`` the noise of a component, nT, negative for the
    plain residual |x| - B. With ``is_newton`` the matrix alone is weighed by psi' in place of psi / r, at least
    `_LEAST_SLOPE` of that: the second derivative of the cost but for the curvature of the residuals. Chunks without any
    weight are passed over. Each loop writes one array: those are the loops that become vector instructions.
    """
    n, k, m_rates = h.shape[0], z.shape[1], rate.shape[1]
    p = 9 + 3 * k + m_rates
    l11, l21, l22 = theta[0], theta[1], theta[2]
    l31, l32, l33 = theta[3], theta[4], theta[5]
    c1, c2, c3 = theta[6], theta[7], theta[8]
    width = min(_CHUNK, max(n, 1))
    rows, total = np.zeros((p + 1 + (p + 1) % 2, width)), np.zeros((p + 2, p + 2))
    u = np.empty((3, width))
    u1, u2, u3 = u[0], u[1], u[2]
    h1, h2, h3 = np.empty(width), np.empty(width), np.empty(width)
    length, r, root, inverse = np.empty(width), np.empty(width), np.empty(width), np.empty(width)
    last = rows[p]
    extra = np.empty((6 if sigma >= 0.0 else 0, width))
    cost = 0.0
    for start in range(0, n, width):
        count = min(width, n - start)
        weights = weight[start : start + count]
        if not has_weight(weights):
            continue
        chunk, field = h[start : start + count], b[start : start + count]
        for i in range(count):
            h1[i] = chunk[i, 0]
        for i in range(count):
            h2[i] = chunk[i, 1]
        for i in range(count):
            h3[i] = chunk[i, 2]
        for i in range(count):
            u1[i] = l11 * h1[i] - c1
        for i in range(count):
            u2[i] = l21 * h1[i] + l22 * h2[i] - c2
        for i in range(count):
            u3[i] = l31 * h1[i] + l32 * h2[i] + l33 * h3[i] - c3
        for j in range(k):
            column = z[start : start + count, j]
            for axis in range(3):
                along, slope = u[axis], theta[9 + 3 * j + axis]
                for i in range(count):
                    along[i] -= slope * column[i]
        for i in range(count):
            length[i] = math.sqrt(u1[i] * u1[i] + u2[i] * u2[i] + u3[i] * u3[i]) + 1e-300
        for i in range(count):
            inverse[i] = 1.0 / length[i]
        for axis in range(3):
            along = u[axis]
            for i in range(count):
                along[i] *= inverse[i]
        for i in range(count):
            r[i] = length[i] - field[i]
        for m in range(m_rates):
            column, slope = rate[start : start + count, m], theta[9 + 3 * k + m]
            for i in range(count):
                r[i] += slope * column[i]
        inverse[:] = 1.0
        if sigma >= 0.0:
            _geometric(theta, sigma, length, r[:count], u, extra, inverse)
        cost += _weigh(r[:count], weights, loss, bend, is_newton, root, last)
        for axis in range(3):
            along = u[axis]
            for i in range(count):
                along[i] *= root[i]
        for i in range(count):
            rows[0, i] = u1[i] * h1[i]
        for i in range(count):
            rows[1, i] = u2[i] * h1[i]
        for i in range(count):
            rows[2, i] = u2[i] * h2[i]
        for i in range(count):
            rows[3, i] = u3[i] * h1[i]
        for i in range(count):
            rows[4, i] = u3[i] * h2[i]
        for i in range(count):
            rows[5, i] = u3[i] * h3[i]
        for c in range(extra.shape[0]):
            row, added = rows[c], extra[c]
            for i in range(count):
                row[i] += root[i] * added[i]
        for axis in range(3):
            row, along = rows[6 + axis], u[axis]
            for i in range(count):
                row[i] = -along[i]
        for j in range(k):
            column = z[start : start + count, j]
            for axis in range(3):
                row, along = rows[9 + 3 * j + axis], u[axis]
                for i in range(count):
                    row[i] = -along[i] * column[i]
        for m in range(m_rates):
            row, column = rows[9 + 3 * k + m], rate[start : start + count, m]
            for i in range(count):
                row[i] = root[i] * column[i] * inverse[i]
        add_products(rows, count, total)
    for c in range(p):
        for d in range(c, p):
            normal[c, d] = total[c, d]
            normal[d, c] = total[c, d]
        gradient[c] = total[c, p]
    return cost


@kernel()
def accumulate_blocks(  # noqa: PLR0917
    h: Floats,
    b: Floats,
    weight: Floats,
    z: Floats,
    rate: Floats,
    theta: Floats,
    loss: int,
    bend: float,
    sigma: float,
    starts: NDArray[np.intp],
    normals: Floats,
    gradients: Floats,
) -> None:  # pragma: no cover - compiled
    """Leave what `accumulate` gives for each block that begins at ``starts`` in ``normals`` and ``gradients``."""
    for k in range(starts.size):
        i = starts[k]
        j = starts[k + 1] if k + 1 < starts.size else h.shape[0]
        hs, bs, ws, zs, rates = h[i:j], b[i:j], weight[i:j], z[i:j], rate[i:j]
        accumulate(hs, bs, ws, zs, rates, theta, loss, bend, sigma, False, normals[k], gradients[k])


@kernel()
def residuals(  # noqa: PLR0917
    h: Floats, b: Floats, z: Floats, rate: Floats, theta: Floats, sigma: float, out: Floats
) -> None:  # pragma: no cover - compiled
    """Leave the residual of every sample, as `accumulate` has it, in ``out``, shape (n,), nT."""
    n, k, m_rates = h.shape[0], z.shape[1], rate.shape[1]
    for s in range(n):
        x1 = theta[0] * h[s, 0] - theta[6]
        x2 = theta[1] * h[s, 0] + theta[2] * h[s, 1] - theta[7]
        x3 = theta[3] * h[s, 0] + theta[4] * h[s, 1] + theta[5] * h[s, 2] - theta[8]
        for j in range(k):
            x1 -= theta[9 + 3 * j] * z[s, j]
            x2 -= theta[10 + 3 * j] * z[s, j]
            x3 -= theta[11 + 3 * j] * z[s, j]
        length = math.sqrt(x1 * x1 + x2 * x2 + x3 * x3) + 1e-300
        r = length - b[s]
        for m in range(m_rates):
            r += theta[9 + 3 * k + m] * rate[s, m]
        if sigma >= 0.0:
            g1 = (theta[0] * x1 + theta[1] * x2 + theta[3] * x3) / length
            g2 = (theta[2] * x2 + theta[4] * x3) / length
            g3 = theta[5] * x3 / length
            q = g1 * g1 + g2 * g2 + g3 * g3
            trace = 0.0
            for i in range(6):
                trace += theta[i] * theta[i]
            r = (r - sigma * sigma * (trace - q) / (2.0 * length)) / math.sqrt(q)
        out[s] = r


def geometric_residuals_nt(h_nt: Floats, b_nt: Floats, theta: Floats) -> Floats:
    """Return the distance of each reading from the ellipsoid |L h - c| = B, to first order, shape (n,), nT.

    ``theta``: L's lower half row by row, and c, shape (9,).
    """
    out, none = np.empty(len(b_nt)), np.zeros((len(b_nt), 0))
    residuals(np.require(h_nt, np.float64, ["C", "W"]), b_nt, none, none, theta, 0.0, out)
    return out

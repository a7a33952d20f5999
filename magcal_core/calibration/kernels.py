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
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LOSSES: Final[dict[str, int]] = {"none": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}
"""Robust loss -> its number in the kernels."""
TUNING: Final[tuple[float, ...]] = (1.0, 1.345, 1.345, 2.3849, 4.6851)
"""Residual, in robust standard deviations, at which each loss bends: 95 % efficiency on Gaussian noise."""

_CHUNK: Final = 256
_FAST: Final = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, inline="always")
def _loss(loss: int, s2: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """Return rho(s^2), with rho ~ s^2 at zero, and the weight rho'(s^2)."""
    rho, weight = s2, 1.0
    if loss == 1 and s2 > 1.0:
        s = math.sqrt(s2)
        rho, weight = 2.0 * s - 1.0, 1.0 / s
    elif loss == 2:
        root = math.sqrt(1.0 + s2)
        rho, weight = 2.0 * (root - 1.0), 1.0 / root
    elif loss == 3:
        rho, weight = math.log1p(s2), 1.0 / (1.0 + s2)
    elif loss == 4:
        left = max(0.0, 1.0 - s2)
        rho, weight = (1.0 - left * left * left) / 3.0, left * left
    return rho, weight


@njit(cache=True, nogil=True, fastmath=_FAST)
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
    normal: Floats,
    gradient: Floats,
) -> float:  # pragma: no cover - compiled
    """Return the cost at ``theta`` and leave J^T W J in ``normal`` and J^T W r in ``gradient``.

    ``bend`` is the residual, nT, at which ``loss`` bends; ``sigma`` the noise of a component, nT, negative for the
    plain residual |x| - B.
    """
    n, k, m_rates = h.shape[0], z.shape[1], rate.shape[1]
    p = 9 + 3 * k + m_rates
    l11, l21, l22 = theta[0], theta[1], theta[2]
    l31, l32, l33 = theta[3], theta[4], theta[5]
    s11, s12, s13 = l11 * l11, l11 * l21, l11 * l31
    s22, s23, s33 = l21 * l21 + l22 * l22, l21 * l31 + l22 * l32, l31 * l31 + l32 * l32 + l33 * l33
    trace = s11 + s22 + s33
    rows = np.empty((p + 1, _CHUNK))
    normal[:, :] = 0.0
    gradient[:] = 0.0
    cost = 0.0
    for start in range(0, n, _CHUNK):
        count = min(_CHUNK, n - start)
        for i in range(count):
            s = start + i
            h1, h2, h3 = h[s, 0], h[s, 1], h[s, 2]
            x1 = l11 * h1 - theta[6]
            x2 = l21 * h1 + l22 * h2 - theta[7]
            x3 = l31 * h1 + l32 * h2 + l33 * h3 - theta[8]
            for j in range(k):
                zj = z[s, j]
                x1 -= theta[9 + 3 * j] * zj
                x2 -= theta[10 + 3 * j] * zj
                x3 -= theta[11 + 3 * j] * zj
            length = math.sqrt(x1 * x1 + x2 * x2 + x3 * x3) + 1e-300
            u1, u2, u3 = x1 / length, x2 / length, x3 / length
            r = length - b[s]
            for m in range(m_rates):
                r += theta[9 + 3 * k + m] * rate[s, m]
            a1, a2, a3 = u1, u2, u3
            inverse = 1.0
            if sigma >= 0.0:
                v1 = s11 * u1 + s12 * u2 + s13 * u3
                v2 = s12 * u1 + s22 * u2 + s23 * u3
                v3 = s13 * u1 + s23 * u2 + s33 * u3
                q = u1 * v1 + u2 * v2 + u3 * v3
                inverse = 1.0 / math.sqrt(q)
                half = sigma * sigma / (2.0 * length)
                beta = half * (trace - q)
                r = (r - beta) * inverse
                kappa = half * inverse - 0.5 * r / q
                turn = 2.0 * kappa / length
                along = (1.0 + beta / length) * inverse - turn * q
                a1 = along * u1 + turn * v1
                a2 = along * u2 + turn * v2
                a3 = along * u3 + turn * v3
            rho, w = _loss(loss, (r / bend) * (r / bend))
            root = math.sqrt(w * weight[s])
            cost += weight[s] * (rho * bend * bend if loss != 0 else r * r)
            rows[0, i] = root * a1 * h1
            rows[1, i] = root * a2 * h1
            rows[2, i] = root * a2 * h2
            rows[3, i] = root * a3 * h1
            rows[4, i] = root * a3 * h2
            rows[5, i] = root * a3 * h3
            if sigma >= 0.0:
                g1 = l11 * u1 + l21 * u2 + l31 * u3
                g2, g3 = l22 * u2 + l32 * u3, l33 * u3
                f, e = 2.0 * kappa, 2.0 * half * inverse
                rows[0, i] += root * (f * u1 * g1 - e * l11)
                rows[1, i] += root * (f * u2 * g1 - e * l21)
                rows[2, i] += root * (f * u2 * g2 - e * l22)
                rows[3, i] += root * (f * u3 * g1 - e * l31)
                rows[4, i] += root * (f * u3 * g2 - e * l32)
                rows[5, i] += root * (f * u3 * g3 - e * l33)
            rows[6, i] = -root * a1
            rows[7, i] = -root * a2
            rows[8, i] = -root * a3
            for j in range(k):
                zj = z[s, j]
                rows[9 + 3 * j, i] = -root * a1 * zj
                rows[10 + 3 * j, i] = -root * a2 * zj
                rows[11 + 3 * j, i] = -root * a3 * zj
            for m in range(m_rates):
                rows[9 + 3 * k + m, i] = root * rate[s, m] * inverse
            rows[p, i] = root * r
        for c in range(p):
            for d in range(c, p + 1):
                total = 0.0
                for i in range(count):
                    total += rows[c, i] * rows[d, i]
                if d < p:
                    normal[c, d] += total
                else:
                    gradient[c] += total
    for c in range(p):
        for d in range(c):
            normal[c, d] = normal[d, c]
    return cost


@njit(cache=True, nogil=True)
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
        accumulate(h[i:j], b[i:j], weight[i:j], z[i:j], rate[i:j], theta, loss, bend, sigma, normals[k], gradients[k])


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def loss_terms(scaled: Floats, loss: int, weight: Floats, slope: Floats) -> None:  # pragma: no cover - compiled
    """Leave weight and psi' of every residual in ``weight`` and ``slope``; ``scaled`` is in units of the bend."""
    for i in range(scaled.shape[0]):
        s2 = scaled[i] * scaled[i]
        weight[i] = _loss(loss, s2)[1]
        if loss == 1:
            slope[i] = 1.0 if s2 <= 1.0 else 0.0
        elif loss == 2:
            slope[i] = (1.0 + s2) ** -1.5
        elif loss == 3:
            slope[i] = (1.0 - s2) / (1.0 + s2) ** 2
        elif loss == 4:
            slope[i] = 0.0 if s2 >= 1.0 else (1.0 - s2) * (1.0 - 5.0 * s2)
        else:
            slope[i] = 1.0

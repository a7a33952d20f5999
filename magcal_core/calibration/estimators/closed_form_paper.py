"""The printed formulas of the Lagrange paper: sums, quadratics, roots [LAGRANGE]_; numbers in brackets are equations.

The formulas work on raw sums, as the paper prints them. They lose digits where the field hardly varies and are 0/0
where its sums vanish; both are reported, neither is hidden.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from magcal_core.arrays import Floats

_TINY: Final = 1e-12
"""Share of its own terms below which a sum is zero to rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """Weighted sums: N, C_i = sum B_i, H_i = sum h_i, F_i = sum h_i^2, D_ij = sum B_i h_j, G_ij = sum B_i B_j."""

    n: float
    C: Floats
    H: Floats
    F: Floats
    D: Floats
    G: Floats


@dataclass(frozen=True, slots=True)
class Root:
    """One root of an axis: its unknowns, what the paper's "any of" formulas give for each, or why it is undefined."""

    values: tuple[float, ...]
    formulas: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    undefined: str | None = None


def sums_of(h_nt: Floats, b_nt: Floats, weights: Floats) -> Sums:
    """Return the sums over readings and fields, both of shape (n, 3), nT."""
    w = weights[:, None]
    return Sums(
        float(weights.sum()),
        weights @ b_nt,
        weights @ h_nt,
        weights @ h_nt**2,
        (b_nt * w).T @ h_nt,
        (b_nt * w).T @ b_nt,
    )


def _ratio(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator != 0.0 else float("nan")


def axis_1(s: Sums) -> tuple[float, float]:
    """Return gamma1 and b1 (11)."""
    gamma = _ratio(s.n * s.D[0, 0] - s.C[0] * s.H[0], s.n * s.F[0] - s.H[0] ** 2)
    bias = _ratio(s.D[0, 0] * s.H[0] - s.C[0] * s.F[0], s.n * s.D[0, 0] - s.C[0] * s.H[0])
    return float(gamma), float(bias)


def axis_2_roots(s: Sums) -> tuple[Root, Root]:
    """Return the two roots (22) of the quadratic (21): alpha1, p2 = beta1 gamma2 by (18.1), b2."""
    C1, C2 = s.C[0], s.C[1]
    K = C1 * s.F[1] - s.D[0, 1] * s.H[1]
    L = s.H[1] ** 2 - s.n * s.F[1]
    M = s.n * s.D[0, 1] - C1 * s.H[1]
    top = C2 * K + s.G[0, 1] * L + s.D[1, 1] * M
    bottom = C1 * K + s.G[0, 0] * L + s.D[0, 1] * M
    if _vanishes(s, 0):
        first = Root((), undefined="the first component of the field sums to zero: alpha1 = -C2/C1 is infinite")
    else:
        first = _axis_2(s, -C2 / C1)
    return first, _axis_2(s, -_ratio(top, bottom))


def _vanishes(s: Sums, axis: int) -> bool:
    return bool(abs(s.C[axis]) <= _TINY * np.sqrt(s.n * s.G[axis, axis]))


def _axis_2(s: Sums, alpha: float) -> Root:
    (C1, C2, _), H2, F2, n = s.C, s.H[1], s.F[1], s.n
    D12, D22, G11, G12 = s.D[0, 1], s.D[1, 1], s.G[0, 0], s.G[0, 1]
    b_19 = _ratio((D12 * H2 - C1 * F2) * alpha + D22 * H2 - C2 * F2, (n * D12 - C1 * H2) * alpha + n * D22 - C2 * H2)
    b_20 = _ratio((G11 * H2 - C1 * D12) * alpha + G12 * H2 - C2 * D12, (n * G11 - C1**2) * alpha + n * G12 - C1 * C2)
    bias = b_19 if np.isfinite(b_19) else b_20
    p_1 = _ratio(D22 - C2 * bias + alpha * (D12 - C1 * bias), F2 - 2 * H2 * bias + n * bias**2)
    p_2 = _ratio(G11 * alpha + G12, D12 - C1 * bias)
    p_3 = _finite_ratio(C1 * alpha + C2, H2 - n * bias, abs(C1 * alpha) + abs(C2), abs(H2) + abs(n * bias))
    formulas = {"b2": (b_19, b_20), "gamma2": (p_1, p_2, p_3)}
    return Root((float(alpha), float(p_1), float(bias)), formulas)


def _finite_ratio(numerator: float, denominator: float, top: float, bottom: float) -> float:
    """Return the ratio, NaN where it is 0/0 to rounding; ``top`` and ``bottom`` are the sizes of the terms."""
    if abs(numerator) <= 1e-9 * top and abs(denominator) <= 1e-9 * bottom:
        return float("nan")
    return _ratio(numerator, denominator)


def axis_3_roots(s: Sums) -> tuple[Root, Root]:
    """Return the two roots (35): s = alpha2 beta3 by (30), alpha3, p3 = beta2 beta3 gamma3 by (28.2), b3."""
    C, G, D, H3, F3, n = s.C, s.G, s.D, s.H[2], s.F[2], s.n
    b_first = _ratio(G[0, 0] * H3 - C[0] * D[0, 2], n * G[0, 0] - C[0] ** 2)
    left = np.array([[*G[0]], [*G[1]], [*D[:, 2]], [*C]])
    top = np.column_stack([left, [D[0, 2], D[1, 2], F3, H3]])
    bottom = np.column_stack([left, [C[0], C[1], H3, n]])
    b_second = _determinant_ratio(top, bottom)
    vanished = all(_vanishes(s, axis) for axis in range(3))
    if vanished or abs(H3 - n * b_first) <= 1e-9 * (abs(H3) + abs(n * b_first)) + 1e-300:
        why = "the field sums to zero: (28)-(33) are 0/0"
        first, second = Root((), undefined=why), Root((), undefined=why) if vanished else _axis_3(s, b_second)
        return first, second
    return _axis_3(s, b_first), _axis_3(s, b_second)


def _determinant_ratio(top: Floats, bottom: Floats) -> float:
    rows, columns = np.abs(bottom).max(axis=1), np.abs(bottom[:, :3]).max(axis=0)
    if not rows.all() or not columns.all():
        return float("nan")
    scale = np.outer(rows, [*columns, 1.0])
    return _ratio(float(np.linalg.det(top / scale)), float(np.linalg.det(bottom / scale)))


def _axis_3(s: Sums, b: float) -> Root:
    (C1, C2, C3), H3, F3, n = s.C, s.H[2], s.F[2], s.n
    G11, G12, G13, G22, G23 = s.G[0, 0], s.G[0, 1], s.G[0, 2], s.G[1, 1], s.G[1, 2]
    D13, D23, D33 = s.D[:, 2]
    x, z, y = D13 - C1 * b, D23 - C2 * b, H3 - n * b
    u, v = D33 - C3 * b, F3 - 2 * H3 * b + n * b**2
    X1, X2 = C1 * G13 - C3 * G11, C2 * G11 - C1 * G12
    a_32 = _ratio(
        (H3 * b - F3) * X1 + (n * b - H3) * (D33 * G11 - D13 * G13) + (C1 * b - D13) * (C3 * D13 - C1 * D33),
        (H3 * b - F3) * X2 + (n * b - H3) * (D13 * G12 - D23 * G11) + (C1 * b - D13) * (C1 * D23 - C2 * D13),
    )
    a_33 = _ratio(
        (D23 - C2 * b) * X1 + (n * b - H3) * (G12 * G13 - G11 * G23) + (C1 * b - D13) * (C1 * G23 - C3 * G12),
        (D23 - C2 * b) * X2 + (n * b - H3) * (G11 * G22 - G12**2) + (C1 * b - D13) * (C2 * G12 - C1 * G22),
    )
    alpha = a_32 if np.isfinite(a_32) else a_33
    s_29 = _finite_ratio(
        (G12 * y - C2 * x) * alpha + G13 * y - C3 * x,
        C1 * x - G11 * y,
        abs(G12 * y * alpha) + abs(C2 * x * alpha) + abs(G13 * y) + abs(C3 * x),
        abs(C1 * x) + abs(G11 * y),
    )
    s_30 = _ratio((y * z - C2 * v) * alpha + y * u - C3 * v, C1 * v - y * x)
    s_31 = _ratio((C2 * z - G22 * y) * alpha + C3 * z - G23 * y, G12 * y - C1 * z)
    p = [
        _ratio(G13 + G11 * s_30 + G12 * alpha, x),
        _ratio(u + x * s_30 + z * alpha, v),
        _ratio(C3 + C1 * s_30 + C2 * alpha, y),
        _ratio(G23 + G12 * s_30 + G22 * alpha, z),
    ]
    beta = float(np.hypot(1.0, alpha))
    formulas = {"alpha3": (a_32, a_33), "alpha2": tuple(v / beta for v in (s_29, s_30, s_31)), "gamma3": tuple(p)}
    return Root((float(s_30), float(alpha), float(p[1]), float(b)), formulas)

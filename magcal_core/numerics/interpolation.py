"""Interpolation in tables of positions: Lagrange and Hermite polynomials over the nearest nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Nanoseconds

_CHUNK: Final = 65_536


@dataclass(frozen=True, slots=True, eq=False)
class StateTable:
    """Positions and velocities at increasing times.

    Attributes
    ----------
    stamps_ns : int64, shape (k,)
        Nanoseconds since 1970, UTC or any scale without steps between the nodes.
    r_km, v_km_s : shape (k, 3)
        In one frame.
    """

    stamps_ns: Nanoseconds
    r_km: Floats
    v_km_s: Floats

    def lagrange(self, stamps_ns: Nanoseconds, degree: int) -> tuple[Floats, Floats]:
        """Return positions and velocities at ``stamps_ns``, (n, 3) each, both over ``degree`` + 1 nodes."""
        states = np.concatenate([self.r_km, self.v_km_s], axis=1)
        out = np.empty((len(stamps_ns), 6))
        for rows in _chunks(len(stamps_ns)):
            nodes, t_s, at_s = self._stencil(stamps_ns[rows], degree + 1)
            weights = _lagrange_weights(t_s, at_s)
            out[rows] = np.einsum("nj,njc->nc", weights, states[nodes])
        return out[:, :3].copy(), out[:, 3:].copy()

    def hermite(self, stamps_ns: Nanoseconds, degree: int) -> tuple[Floats, Floats]:
        """Return positions and velocities at ``stamps_ns``, (n, 3) each: a polynomial of that degree and its slope.

        It has the positions and the velocities of (``degree`` + 2) // 2 nodes.
        """
        r_km, v_km_s = np.empty((len(stamps_ns), 3)), np.empty((len(stamps_ns), 3))
        for rows in _chunks(len(stamps_ns)):
            nodes, t_s, at_s = self._stencil(stamps_ns[rows], (degree + 2) // 2)
            r_km[rows], v_km_s[rows] = _hermite(t_s, at_s, self.r_km[nodes], self.v_km_s[nodes])
        return r_km, v_km_s

    def _stencil(self, stamps_ns: Nanoseconds, count: int) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Return the ``count`` nodes about each time, (n, count), their times and the times, s from the first."""
        after = np.searchsorted(self.stamps_ns, stamps_ns, side="right")
        first = np.clip(after - count // 2 - count % 2, 0, len(self.stamps_ns) - count)
        nodes = first[:, None] + np.arange(count)
        start = self.stamps_ns[first]
        return nodes, (self.stamps_ns[nodes] - start[:, None]) / 1e9, (stamps_ns - start) / 1e9


def _chunks(n: int) -> list[slice]:
    return [slice(start, min(start + _CHUNK, n)) for start in range(0, n, _CHUNK)]


def _lagrange_weights(t_s: Floats, at_s: Floats) -> Floats:
    """Return the weight of each node, shape (n, k)."""
    k = t_s.shape[1]
    weights = np.ones_like(t_s)
    for j in range(k):
        for m in range(k):
            if m != j:
                weights[:, j] *= (at_s - t_s[:, m]) / (t_s[:, j] - t_s[:, m])
    return weights


def _hermite(t_s: Floats, at_s: Floats, r_km: Floats, v_km_s: Floats) -> tuple[Floats, Floats]:
    """Return value and slope of the polynomial through nodes (n, k) with given slopes: Newton's form, nodes doubled."""
    z_s = np.repeat(t_s, 2, axis=1)
    order = z_s.shape[1]
    table = np.repeat(r_km, 2, axis=1)
    coefficients = [table[:, 0]]
    for level in range(1, order):
        span_s = z_s[:, level:] - z_s[:, :-level]
        is_double = span_s == 0.0
        divided = np.diff(table, axis=1) / np.where(is_double, 1.0, span_s)[:, :, None]
        if level == 1:
            divided[:, ::2] = v_km_s
        table = divided
        coefficients.append(table[:, 0])
    value, slope = coefficients[-1].copy(), np.zeros_like(coefficients[-1])
    for level in range(order - 2, -1, -1):
        step_s = (at_s - z_s[:, level])[:, None]
        slope = slope * step_s + value
        value = value * step_s + coefficients[level]
    return value, slope


@lru_cache(maxsize=4)
def lagrange_powers(count: int) -> Floats:
    """Return the matrix, (k, k), from values at k points, one apart about 0, to coefficients of powers 0 to k - 1."""
    nodes = np.arange(count) - (count - 1) / 2.0
    columns = []
    for node in nodes:
        others = nodes[nodes != node]
        columns.append(polynomial.polyfromroots(others) / np.prod(node - others))
    return np.stack(columns, axis=1)

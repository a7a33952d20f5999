"""The sum over harmonics, over blocks of samples that share an interval between knots."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.numerics.kernel import kernel

BLOCK: Final = 64
"""Samples a block: its arrays stay in the first-level cache, and every inner loop runs over them as vectors."""


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def sum_harmonics(  # noqa: PLR0912, PLR0915, PLR0917 (one derivation, and numba takes no keyword arguments)
    stamps_ns: Nanoseconds,
    r_km: Floats,
    radius_km: float,
    knots_ns: Nanoseconds,
    value_nt: Floats,
    slope_nt: Floats,
    recursion: Floats,
    limits_km: tuple[float, float],
    field_nt: Floats,
) -> int:
    """Write the field to ``field_nt``, shape (n, 3), nT, and return how many radii are not within ``limits_km``.

    Notes
    -----
    `magcal_core.field.harmonics` has the equations: for each order m from the highest down, the sums over n of the six
    series, then one step of Horner's rule in Z. Two degrees are summed in one pass over the block, which halves the
    traffic with the cache. A block that is not full repeats its last sample, so a sample's field does not depend on its
    neighbours.
    """
    order = recursion.shape[0] - 1
    n = len(stamps_ns)
    f, q, x = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    z_re, z_im = np.empty(BLOCK), np.empty(BLOCK)
    q_1, q_2 = np.empty(BLOCK), np.empty(BLOCK)
    c_x, s_x, c_y, s_y, c_z, s_z = (
        np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    )  # fmt: skip
    x_re, x_im, y_re, y_im, w_re, w_im = (
        np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    )  # fmt: skip
    least, largest = (radius_km / limits_km[1]) ** 2, (radius_km / limits_km[0]) ** 2
    interval, start, outside = 0, 0, 0
    while start < n:
        while stamps_ns[start] < knots_ns[interval]:
            interval -= 1
        while interval < len(knots_ns) - 2 and stamps_ns[start] >= knots_ns[interval + 1]:
            interval += 1
        low, high = knots_ns[interval], knots_ns[interval + 1]
        is_last = interval == len(knots_ns) - 2
        width = 1
        while width < min(BLOCK, n - start) and low <= stamps_ns[start + width] < high + is_last:
            width += 1
        span_ns = float(high - low)
        for i in range(BLOCK):
            j = start + min(i, width - 1)
            px, py, pz = r_km[j, 0], r_km[j, 1], r_km[j, 2]
            inverse = radius_km / (px * px + py * py + pz * pz)
            q[i] = radius_km * inverse
            z_re[i], z_im[i], x[i] = px * inverse, py * inverse, pz * inverse
            f[i] = float(stamps_ns[j] - low) / span_ns
        for i in range(width):
            outside += not (q[i] >= least and q[i] <= largest)
        value, slope = value_nt[interval], slope_nt[interval]
        a, b = value[order, order], slope[order, order]
        for i in range(BLOCK):
            t = f[i]
            x_re[i], x_im[i] = a[0] + t * b[0], a[1] + t * b[1]
            y_re[i], y_im[i] = a[2] + t * b[2], a[3] + t * b[3]
            w_re[i], w_im[i] = a[4] + t * b[4], a[5] + t * b[5]
        for m in range(order - 1, -1, -1):
            a, b, c, d = value[m, m], slope[m, m], value[m, m + 1], slope[m, m + 1]
            a0, a1, a2, a3, a4, a5 = a[0], a[1], a[2], a[3], a[4], a[5]
            b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
            c0, c1, c2, c3, c4, c5 = c[0], c[1], c[2], c[3], c[4], c[5]
            d0, d1, d2, d3, d4, d5 = d[0], d[1], d[2], d[3], d[4], d[5]
            for i in range(BLOCK):
                t, v = f[i], x[i]
                q_2[i], q_1[i] = 1.0, v
                c_x[i] = (a0 + t * b0) + v * (c0 + t * d0)
                s_x[i] = (a1 + t * b1) + v * (c1 + t * d1)
                c_y[i] = (a2 + t * b2) + v * (c2 + t * d2)
                s_y[i] = (a3 + t * b3) + v * (c3 + t * d3)
                c_z[i] = (a4 + t * b4) + v * (c4 + t * d4)
                s_z[i] = (a5 + t * b5) + v * (c5 + t * d5)
            degree = m + 2
            while degree < order:
                first, second = recursion[m, degree], recursion[m, degree + 1]
                a, b, c, d = value[m, degree], slope[m, degree], value[m, degree + 1], slope[m, degree + 1]
                a0, a1, a2, a3, a4, a5 = a[0], a[1], a[2], a[3], a[4], a[5]
                b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
                c0, c1, c2, c3, c4, c5 = c[0], c[1], c[2], c[3], c[4], c[5]
                d0, d1, d2, d3, d4, d5 = d[0], d[1], d[2], d[3], d[4], d[5]
                for i in range(BLOCK):
                    t = f[i]
                    u = first * (x[i] * q_1[i]) - q[i] * q_2[i]
                    v = second * (x[i] * u) - q[i] * q_1[i]
                    q_2[i], q_1[i] = u, v
                    c_x[i] = (c_x[i] + u * (a0 + t * b0)) + v * (c0 + t * d0)
                    s_x[i] = (s_x[i] + u * (a1 + t * b1)) + v * (c1 + t * d1)
                    c_y[i] = (c_y[i] + u * (a2 + t * b2)) + v * (c2 + t * d2)
                    s_y[i] = (s_y[i] + u * (a3 + t * b3)) + v * (c3 + t * d3)
                    c_z[i] = (c_z[i] + u * (a4 + t * b4)) + v * (c4 + t * d4)
                    s_z[i] = (s_z[i] + u * (a5 + t * b5)) + v * (c5 + t * d5)
                degree += 2
            if degree == order:
                first = recursion[m, degree]
                a, b = value[m, degree], slope[m, degree]
                a0, a1, a2, a3, a4, a5 = a[0], a[1], a[2], a[3], a[4], a[5]
                b0, b1, b2, b3, b4, b5 = b[0], b[1], b[2], b[3], b[4], b[5]
                for i in range(BLOCK):
                    t = f[i]
                    u = first * (x[i] * q_1[i]) - q[i] * q_2[i]
                    c_x[i] += u * (a0 + t * b0)
                    s_x[i] += u * (a1 + t * b1)
                    c_y[i] += u * (a2 + t * b2)
                    s_y[i] += u * (a3 + t * b3)
                    c_z[i] += u * (a4 + t * b4)
                    s_z[i] += u * (a5 + t * b5)
            for i in range(BLOCK):
                re, im = z_re[i], z_im[i]
                u, v = x_re[i], x_im[i]
                x_re[i], x_im[i] = u * re - v * im + c_x[i], u * im + v * re + s_x[i]
                u, v = y_re[i], y_im[i]
                y_re[i], y_im[i] = u * re - v * im + c_y[i], u * im + v * re + s_y[i]
                u, v = w_re[i], w_im[i]
                w_re[i], w_im[i] = u * re - v * im + c_z[i], u * im + v * re + s_z[i]
        for i in range(width):
            ratio = math.sqrt(q[i])
            field_nt[start + i, 0] = ratio * x_re[i]
            field_nt[start + i, 1] = ratio * y_re[i]
            field_nt[start + i, 2] = ratio * w_re[i]
        start += width
    return outside

"""Positions at densely sampled times: the orbit at nodes, polynomials between.

Notes
-----
Through the ten nodes about an interval runs a polynomial of degree 9. Nodes lie at whole intervals from the epoch, and
an interval is 0.13 rad of the way at the perigee, 118 s in a low orbit: within a millimetre of the orbit itself there,
within a centimetre in any.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final

import numpy as np
from numba import njit
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from magcal_core.constants import EARTH_GM_KM3_S2

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

SAMPLES_PER_NODE: Final = 3
"""Interpolate where there are at least this many samples for each node."""

_NODES: Final = 10
_BEFORE: Final = _NODES // 2 - 1
_TURN_RAD: Final = 0.13
_MIN_SAMPLES: Final = 1000


def interval_ns(perigee_km: float, apogee_km: float) -> int:
    """Return the distance of the nodes, nanoseconds, for an orbit between these radii, km."""
    semi_major_axis_km = 0.5 * (perigee_km + apogee_km)
    speed_km_s = np.sqrt(EARTH_GM_KM3_S2 * (2.0 / perigee_km - 1.0 / semi_major_axis_km))
    return int(_TURN_RAD * perigee_km / speed_km_s) * 1_000_000_000


def interpolated(
    stamps_ns: Nanoseconds, epoch_ns: int, step_ns: int, positions_km: Callable[[Nanoseconds], Floats]
) -> Floats | None:
    """Return positions at ``stamps_ns``, shape (n, 3), km, from ``positions_km`` at nodes ``step_ns`` apart.

    None where the samples are too few, or too far apart, for interpolation to pay.
    """
    if len(stamps_ns) < _MIN_SAMPLES:
        return None
    first = (int(stamps_ns.min()) - epoch_ns) // step_ns - _BEFORE
    count = (int(stamps_ns.max()) - epoch_ns) // step_ns - first + _NODES - _BEFORE
    if count > 4 * len(stamps_ns):
        return None
    start_ns = epoch_ns + first * step_ns
    interval = (stamps_ns - start_ns) // step_ns
    is_used = np.zeros(count, np.bool_)
    is_used[interval] = True
    used = np.flatnonzero(is_used)
    is_node = np.zeros(count, np.bool_)
    for offset in range(-_BEFORE, _NODES - _BEFORE):
        is_node[used + offset] = True
    nodes = np.flatnonzero(is_node)
    if len(nodes) * SAMPLES_PER_NODE > len(stamps_ns):
        return None
    r_nodes_km = positions_km(start_ns + nodes * step_ns)
    row_of_node = np.cumsum(is_node) - 1
    stencils = r_nodes_km[row_of_node[used - _BEFORE][:, None] + np.arange(_NODES)]
    coefficients = np.einsum("kj,ijc->ikc", lagrange_powers(_NODES), stencils)
    row_of_interval = (np.cumsum(is_used) - 1)[interval]
    r_km = np.empty((len(stamps_ns), 3))
    _horner(stamps_ns, start_ns + used * step_ns, 1.0 / step_ns, row_of_interval, coefficients, r_km)
    return r_km


@lru_cache(maxsize=4)
def lagrange_powers(count: int) -> Floats:
    """Return the matrix, (k, k), from values at k points, one apart about 0, to coefficients of powers 0 to k - 1."""
    nodes = np.arange(count) - (count - 1) / 2.0
    columns = []
    for node in nodes:
        others = nodes[nodes != node]
        columns.append(polynomial.polyfromroots(others) / np.prod(node - others))
    return np.stack(columns, axis=1)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _horner(  # noqa: PLR0917 (numba takes no keyword arguments)
    stamps_ns: Nanoseconds,
    start_ns: Nanoseconds,
    per_ns: float,
    row_of_interval: NDArray[np.intp],
    coefficients: Floats,
    r_km: Floats,
) -> None:
    degree = coefficients.shape[1] - 1
    for i in range(len(stamps_ns)):
        row = row_of_interval[i]
        v = (stamps_ns[i] - start_ns[row]) * per_ns - 0.5
        c = coefficients[row]
        x, y, z = c[degree, 0], c[degree, 1], c[degree, 2]
        for power in range(degree - 1, -1, -1):
            x = x * v + c[power, 0]
            y = y * v + c[power, 1]
            z = z * v + c[power, 2]
        r_km[i, 0], r_km[i, 1], r_km[i, 2] = x, y, z

"""A smooth function of time at densely sampled times: the function at nodes, polynomials between.

Notes
-----
Through the twelve nodes about an interval runs a polynomial of degree 11. Nodes lie at whole intervals from the epoch.
Of a position an interval is 0.13 rad of the way at the perigee, 118 s in a low orbit: within a millimetre of the orbit
itself there, within a centimetre in any.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Indices, Nanoseconds
from magcal_core.constants import EARTH_GM_KM3_S2
from magcal_core.errors import ModelRangeError, PropagationError
from magcal_core.numerics.interpolation import lagrange_powers
from magcal_core.numerics.kernel import kernel

SAMPLES_PER_NODE: Final = 3
"""Interpolate positions where there are at least this many samples for each node."""

_NODES: Final = 12
_BEFORE: Final = _NODES // 2 - 1
_POSITION_TURN_RAD: Final = 0.13
MIN_SAMPLES: Final = 1000
"""Fewer are not worth the nodes."""
_BLOCK: Final = 64
"""Samples a block of the kernel: its arrays stay in the first-level cache, and every inner loop runs over vectors."""
_CHECKED_AT: Final = 0.381966
"""Where in its interval a polynomial is checked: a part that no table's whole seconds keep to."""


def interval_ns(perigee_km: float, apogee_km: float, turn_rad: float = _POSITION_TURN_RAD) -> int:
    """Return the distance of the nodes, nanoseconds, ``turn_rad`` at the perigee of an orbit between these radii, km.

    By default that of positions.
    """
    semi_major_axis_km = 0.5 * (perigee_km + apogee_km)
    speed_km_s = np.sqrt(EARTH_GM_KM3_S2 * (2.0 / perigee_km - 1.0 / semi_major_axis_km))
    return max(1, int(turn_rad * perigee_km / speed_km_s)) * 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Polynomials:
    """Polynomials of three components in the intervals between nodes.

    Attributes
    ----------
    start_ns, step_ns : int
        Start of the first interval, and the length of each, nanoseconds.
    row_of_interval : shape (m,)
        Which polynomial holds in each interval; -1 where none does.
    coefficients : shape (rows, k, 3)
        By power of the time from the middle of the interval, in intervals.
    """

    start_ns: int
    step_ns: int
    row_of_interval: Indices
    coefficients: Floats

    @property
    def gap_fraction(self) -> float:
        """Part of the intervals with samples that have no polynomial."""
        return 1.0 - np.count_nonzero(self.row_of_interval >= 0) / len(self.coefficients)

    def at(self, stamps_ns: Nanoseconds) -> Floats:
        """Return the function at ``stamps_ns``, shape (n, 3); NaN where no polynomial holds."""
        values = np.empty((len(stamps_ns), 3))
        _evaluate(stamps_ns, self.start_ns, self.step_ns, self.row_of_interval, self.coefficients, values)
        return values


def interpolated(
    stamps_ns: Nanoseconds, epoch_ns: int, step_ns: int, values: Callable[[Nanoseconds], Floats]
) -> Floats | None:
    """Return a function at ``stamps_ns``, shape (n, 3), from its ``values`` at nodes ``step_ns`` apart.

    None where the samples are too few, or too far apart, for interpolation to pay, and where a node, which lies up to
    six intervals beyond them, has no value: the samples themselves then tell whether that is an error.
    """
    if len(stamps_ns) < MIN_SAMPLES:
        return None
    try:
        fitted = polynomials(stamps_ns, epoch_ns, step_ns, values, samples_per_node=SAMPLES_PER_NODE)
    except (ModelRangeError, PropagationError):
        return None
    return None if fitted is None else fitted.at(stamps_ns)


def polynomials(
    stamps_ns: Nanoseconds,
    epoch_ns: int,
    step_ns: int,
    values: Callable[[Nanoseconds], Floats],
    *,
    samples_per_node: float,
    tolerance: float | None = None,
    margin: int = 0,
) -> Polynomials | None:
    """Return the polynomials of a function in the intervals of ``stamps_ns``, from its ``values`` at nodes.

    Each is compared with the function at one more place of its interval where there is a ``tolerance``, and none holds
    there and in the intervals beside where one is farther away than that. ``margin``: so many intervals before and
    after those of the samples have polynomials too. None where the samples are fewer than ``samples_per_node`` to a
    node.
    """
    placed = _nodes(stamps_ns, epoch_ns, step_ns, margin)
    if placed is None or len(placed[1]) * samples_per_node > len(stamps_ns):
        return None
    start_ns, nodes, first_nodes, row_of_interval = placed
    nodes_ns = start_ns + nodes * step_ns
    checks_ns = start_ns + np.flatnonzero(row_of_interval >= 0) * step_ns + int(_CHECKED_AT * step_ns)
    found = values(nodes_ns if tolerance is None else np.concatenate([nodes_ns, checks_ns]))
    coefficients = np.empty((len(first_nodes), _NODES, 3))
    _fit(found, first_nodes, lagrange_powers(_NODES), coefficients)
    fitted = Polynomials(start_ns, step_ns, row_of_interval, coefficients)
    if tolerance is not None:
        away = np.abs(fitted.at(checks_ns) - found[len(nodes) :]).max(axis=1)
        is_rough = row_of_interval >= 0
        is_rough[is_rough] = ~(away <= tolerance)
        row_of_interval[np.convolve(is_rough, [1, 1, 1], "same") > 0] = -1
    return fitted


def times_needed(stamps_ns: Nanoseconds, epoch_ns: int, step_ns: int, *, margin: int = 0) -> Nanoseconds | None:
    """Return all the times, ascending, at which `polynomials` asks for the function; None where it gives up.

    Of a part of ``stamps_ns`` it asks at some of them.
    """
    placed = _nodes(stamps_ns, epoch_ns, step_ns, margin)
    if placed is None:
        return None
    start_ns, nodes, _, row_of_interval = placed
    checks = start_ns + np.flatnonzero(row_of_interval >= 0) * step_ns + int(_CHECKED_AT * step_ns)
    return np.union1d(start_ns + nodes * step_ns, checks)


def _nodes(
    stamps_ns: Nanoseconds, epoch_ns: int, step_ns: int, margin: int
) -> tuple[int, Indices, Indices, Indices] | None:
    """Return where the intervals begin, which nodes are needed, the first of each polynomial, and its row by interval.

    None for samples that are far farther apart than the nodes.
    """
    first = (int(stamps_ns.min()) - epoch_ns) // step_ns - _BEFORE - margin
    count = (int(stamps_ns.max()) - epoch_ns) // step_ns - first + _NODES - _BEFORE + margin
    if count > 4 * len(stamps_ns):
        return None
    start_ns = epoch_ns + first * step_ns
    is_used = np.zeros(count, np.bool_)
    _mark(stamps_ns, start_ns, step_ns, is_used)
    used = np.flatnonzero(is_used if not margin else np.convolve(is_used, np.ones(2 * margin + 1), "same") > 0)
    is_node = np.zeros(count, np.bool_)
    for offset in range(-_BEFORE, _NODES - _BEFORE):
        is_node[used + offset] = True
    row_of_interval = np.full(count, -1, np.intp)
    row_of_interval[used] = np.arange(len(used))
    return start_ns, np.flatnonzero(is_node), (np.cumsum(is_node) - 1)[used - _BEFORE], row_of_interval


@kernel(error_model="numpy")
def _mark(stamps_ns: Nanoseconds, start_ns: int, step_ns: int, is_used: NDArray[np.bool_]) -> None:
    low = start_ns - step_ns
    for stamp in stamps_ns:
        if not low <= stamp < low + step_ns:
            interval = (stamp - start_ns) // step_ns
            is_used[interval] = True
            low = start_ns + interval * step_ns


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _fit(values: Floats, first_nodes: Indices, powers: Floats, coefficients: Floats) -> None:
    for row, first in enumerate(first_nodes):
        for power in range(_NODES):
            x, y, z = 0.0, 0.0, 0.0
            for node in range(_NODES):
                weight = powers[power, node]
                x += weight * values[first + node, 0]
                y += weight * values[first + node, 1]
                z += weight * values[first + node, 2]
            c = coefficients[row, power]
            c[0], c[1], c[2] = x, y, z


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _evaluate(  # noqa: PLR0917 (numba takes no keyword arguments)
    stamps_ns: Nanoseconds,
    start_ns: int,
    step_ns: int,
    row_of_interval: Indices,
    coefficients: Floats,
    values: Floats,
) -> None:
    n, powers = len(stamps_ns), coefficients.shape[1]
    v, x, y, z = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK)
    per_ns = 1.0 / step_ns
    start = 0
    while start < n:
        interval = (stamps_ns[start] - start_ns) // step_ns
        low = start_ns + interval * step_ns
        width = 1
        while width < min(_BLOCK, n - start) and low <= stamps_ns[start + width] < low + step_ns:
            width += 1
        row = row_of_interval[interval] if 0 <= interval < len(row_of_interval) else -1
        for i in range(width):
            v[i] = (stamps_ns[start + i] - low) * per_ns - 0.5
            x[i] = y[i] = z[i] = 0.0 if row >= 0 else math.nan
        for power in range(powers - 1, -1, -1):
            a, b, c = coefficients[row, power, 0], coefficients[row, power, 1], coefficients[row, power, 2]
            for i in range(width):
                x[i] = x[i] * v[i] + a
                y[i] = y[i] * v[i] + b
                z[i] = z[i] * v[i] + c
        for i in range(width):
            values[start + i, 0], values[start + i, 1], values[start + i, 2] = x[i], y[i], z[i]
        start += width

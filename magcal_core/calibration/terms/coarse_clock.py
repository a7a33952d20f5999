"""A clock that is minutes or hours off, found before any fit: the readings' own quadric against |B|^2 at other times.

Notes
-----
Where h = T B + b, |B|^2 is a quadric of h whatever T and b. The quadric's ten columns are orthonormalised once (Q);
what an offset o leaves is ||y - Q Q'y||, y = |B|^2(t + o) of a spline of the model's field. Offsets beyond 12 h are not
tried: after a day the orbit comes back to the same field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.estimators.many_references import median_residuals
from magcal_core.calibration.estimators.robust_start import FEW_SUBSETS, Quadric
from magcal_core.errors import MagcalError
from magcal_core.observations import Observations

LARGEST_S: Final = 43_200.0
STEP_S: Final = 30.0
FINE_S: Final = 1.0
REACH_S: Final = 40.0
"""How far from a minimum of the coarse steps the fine ones go."""
APART_S: Final = 120.0
MINIMA: Final = 6
BETTER: Final = 1.0 / 3.0
"""Residual of the least minimum, as a share of that at 0, up to which it is taken."""
ALONE: Final = 1.3
"""Residual of the next minimum over the least from which on there is no doubt which one it is."""
POOR: Final = 0.02
"""Residual of the plain quadric, as a share of the field, from which on a clock is looked for."""
_MOST_ROWS: Final = 600
_NODE_S: Final = 60.0
_MOST_NODES: Final = 60_000
_AT_ONCE: Final = 256

Magnitude = Callable[[Times], Floats]
"""Times -> |B| of the model where the orbit has the satellite, shape (n,), nT."""


@dataclass(frozen=True, slots=True)
class CoarseClock:
    """The offset, s, that suits the readings best; its residual over that at 0, and the next minimum's over its own."""

    offset_s: float
    ratio_to_plain: float
    next_ratio: float

    @property
    def is_found(self) -> bool:
        """Whether it explains the readings, and no other offset nearly as well."""
        return self.ratio_to_plain < BETTER and self.next_ratio >= ALONE

    def to_dict(self) -> dict[str, object]:
        """Return the offset as the records have it."""
        return {"offset_s": self.offset_s, "ratio_to_plain": self.ratio_to_plain, "next_ratio": self.next_ratio}


def quadric_share(observations: Observations) -> float:
    """Return what the quadric of the readings leaves of |B|, root mean square, as a share of the mean field.

    Notes
    -----
    |B|^2 errs by 2 |B| times what |B| errs by.
    """
    quadric = _Quadric.of(observations)
    squares = observations.b_nt[quadric.rows] ** 2
    left = float(quadric.left(squares[None])[0]) / np.sqrt(len(squares))
    return float(left / (2.0 * np.mean(squares)))


def coarse_clock(
    observations: Observations, t_utc: Times, magnitude: Magnitude, *, is_clean: bool = True
) -> CoarseClock | None:
    """Return the best offset within 12 h; None where the orbit does not reach so far or nothing can be told.

    Parameters
    ----------
    observations : Observations
    t_utc : shape (n,)
        Their times.
    magnitude : callable
    is_clean : bool
        Whether no row is bad. Bad rows are what a quadric leaves most of, at any offset: beside them offsets are held
        against each other by the median residual, and the minima by the scale that least trimmed squares leave.
    """
    quadric = _Quadric.of(observations)
    if len(quadric.rows) <= quadric.q.shape[1] + 1:
        return None
    at_s = observations.t_s[quadric.rows]
    try:
        squares = _spline(t_utc[0], float(at_s[0]), float(at_s[-1]), magnitude)
    except MagcalError:
        return None
    if squares is None:
        return None

    def left(offsets: Floats) -> Floats:
        parts = np.array_split(offsets, -(-len(offsets) // _AT_ONCE))
        return np.concatenate([some_left(squares(at_s + part[:, None])) for part in parts])

    def some_left(some: Floats) -> Floats:
        return quadric.left(some) if robust is None else median_residuals(robust, np.sqrt(some))

    def scored(offset_s: float, size: float) -> float:
        return size if robust is None else robust.scale_nt(np.sqrt(squares(at_s + offset_s)))

    robust = None if is_clean else Quadric.of(np.ascontiguousarray(observations.h_nt[quadric.rows]), FEW_SUBSETS)
    plain = scored(0.0, float(left(np.zeros(1))[0]))
    offsets = np.arange(-LARGEST_S, LARGEST_S + STEP_S / 2.0, STEP_S)
    minima = []
    for near in _minima(offsets, left(offsets)):
        fine = near + np.arange(-REACH_S, REACH_S + FINE_S / 2.0, FINE_S)
        sizes = left(fine)
        least = int(np.argmin(sizes))
        minima.append((scored(float(fine[least]), float(sizes[least])), float(fine[least])))
    if not minima:
        return None
    minima.sort()
    size, offset_s = minima[0]
    others = [other for other, place in minima[1:] if abs(place - offset_s) >= APART_S]
    following = min(others, default=plain)
    return CoarseClock(offset_s, size / max(plain, 1e-300), following / max(size, 1e-300))


@dataclass(frozen=True, slots=True, eq=False)
class _Quadric:
    """Orthonormal columns, shape (r, 10), of the quadric of the readings ``rows``, times the roots of their weights."""

    rows: NDArray[np.intp]
    root: Floats
    q: Floats

    @classmethod
    def of(cls, o: Observations) -> _Quadric:
        used = np.flatnonzero(o.weights > 0)
        rows = used[:: max(1, -(-len(used) // _MOST_ROWS))]
        h = o.h_nt[rows] / np.median(np.abs(o.h_nt[rows]))
        x, y, z = h.T
        ones = np.ones(len(rows))
        root = np.sqrt(o.weights[rows])
        columns = np.column_stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, ones])
        return cls(rows, root, np.linalg.qr(root[:, None] * columns)[0])

    def left(self, squares: Floats) -> Floats:
        """Return the norm of what the quadric leaves of each of ``squares``, shape (m, r)."""
        y = squares * self.root
        y = y - (y @ self.q) @ self.q.T
        return np.asarray(np.sqrt(np.einsum("mr,mr->m", y, y)))


def _spline(
    begin: np.datetime64, first_s: float, last_s: float, magnitude: Magnitude
) -> Callable[[Floats], Floats] | None:
    """Return |B|^2 at seconds after ``begin``, from nodes 60 s apart that reach `LARGEST_S` beyond both ends."""
    from scipy.interpolate import CubicSpline

    reach = LARGEST_S + REACH_S + _NODE_S
    nodes = np.arange(first_s - reach, last_s + reach + _NODE_S, _NODE_S)
    if len(nodes) > _MOST_NODES:
        return None
    times = begin.astype("datetime64[ns]") + np.round(nodes * 1e9).astype("timedelta64[ns]")
    spline = CubicSpline(nodes, magnitude(times) ** 2)
    return lambda at_s: np.asarray(spline(at_s), np.float64)


def _minima(offsets: Floats, sizes: Floats) -> list[float]:
    """Return the offsets of the least local minima that are `APART_S` from each other."""
    inner = np.flatnonzero((sizes[1:-1] <= sizes[:-2]) & (sizes[1:-1] <= sizes[2:])) + 1
    found: list[float] = []
    for i in inner[np.argsort(sizes[inner], kind="stable")]:
        if all(abs(float(offsets[i]) - other) >= APART_S for other in found):
            found.append(float(offsets[i]))
        if len(found) == MINIMA:
            break
    return found

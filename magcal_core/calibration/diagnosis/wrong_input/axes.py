"""Which sensor axis is which: all 48 signed permutations scored from second moments."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.wrong_input.scores import centred_moments, residual_floor_nt, trimmed

_NAMES: Final = "xyz"
_ORDERS: Final = tuple(itertools.permutations(range(3)))
_SIGNS: Final = tuple(itertools.product((1, -1), repeat=3))
_TIE: Final = 1.05
"""Candidates this close to the best are taken for equal: then the one with the fewest changes is named."""

_RIGHT_SHARE: Final = 0.03
"""Share of the field that a wrong axis leaves at the least: below it nothing needs to be tried."""


@dataclass(frozen=True, slots=True)
class AxisCandidate:
    """The reading of axes that fits best, and the residuals, nT a component, with and without it."""

    name: str
    says: str
    is_left_handed: bool
    before_nt: float
    after_nt: float

    @property
    def ratio(self) -> float:
        """By how much the residual would fall."""
        return self.before_nt / self.after_nt


@dataclass(frozen=True, slots=True)
class _Signed:
    """A signed permutation: axis i is ``signs[i]`` times what was sent as axis ``order[i]``."""

    order: tuple[int, int, int]
    signs: tuple[int, int, int]

    @property
    def text(self) -> str:
        return ", ".join(("-" if s < 0 else "") + _NAMES[j] for j, s in zip(self.order, self.signs, strict=True))

    @property
    def is_flipped(self) -> tuple[bool, ...]:
        return tuple(sign < 0 for sign in self.signs)

    @property
    def changes(self) -> int:
        return sum(i != j for i, j in enumerate(self.order)) + sum(s < 0 for s in self.signs)

    @property
    def is_left_handed(self) -> bool:
        matrix = np.zeros((3, 3))
        matrix[range(3), self.order] = self.signs
        return bool(np.linalg.det(matrix) < 0)


_CANDIDATES: Final = sorted(
    (_Signed((a, b, c), (s, t, u)) for a, b, c in _ORDERS for s, t, u in _SIGNS), key=lambda one: one.changes
)


def best_axes(h_nt: Floats, b_base_nt: Floats) -> AxisCandidate:
    """Return the signed permutation of sensor or reference axes that leaves the least residual.

    Parameters
    ----------
    h_nt, b_base_nt : shape (n, 3)
        Reading and true field in the base frame, nT.

    Notes
    -----
    Each candidate is scored with the sensor model itself, h_i on (1, B_1 .. B_i) with a gain to B_i that is not
    negative: the model's own least squares, read off the second moments of (h, B). A strongly non-orthogonal sensor
    therefore scores as well as a square one. Samples that no linear sensor explains are left out first.
    """
    h_nt, b_base_nt = trimmed(h_nt, b_base_nt)
    floor = residual_floor_nt(b_base_nt)
    moments = centred_moments(h_nt, b_base_nt)
    sent = _as_sent_nt(moments, floor)
    if sent <= _RIGHT_SHARE * float(np.mean(np.linalg.norm(b_base_nt, axis=1))):
        return AxisCandidate("as sent", "the axes are as they were sent", False, sent, sent)
    scored = [(float(np.hypot(left, floor)), one, is_sensor) for left, one, is_sensor in _scored(moments)]
    before = scored[0][0]
    best = min(scored, key=lambda row: row[0])[0]
    after, named, is_sensor = min(
        (row for row in scored if row[0] <= _TIE * best), key=lambda row: (row[1].changes, not row[2], row[0])
    )
    what = "the sensor's axes" if is_sensor else "the reference's axes"
    is_enu = not is_sensor and named.order == (1, 0, 2) and named.signs == (1, 1, -1)
    local = " (NED and ENU exchanged)" if is_enu else ""
    says = f"{what} x, y, z seem to be ({named.text}) of what was sent{local}"
    return AxisCandidate(f"{what} ({named.text})", says, named.is_left_handed, before, after)


def _as_sent_nt(moments: tuple[Floats, Floats, Floats], floor: float) -> float:
    """Return what the sensor model leaves of the axes as they were sent, root mean square of a component, nT."""
    hh, bh, bb = moments
    left = [_row(bb, bh, hh, list(range(axis + 1)))[axis, 0] for axis in range(3)]
    return float(np.hypot(np.sqrt(np.sum(left) / 3.0), floor))


def _scored(moments: tuple[Floats, Floats, Floats]) -> Iterator[tuple[float, _Signed, bool]]:
    """Yield the root mean square of a component, nT, of every candidate, and whether it is one of the sensor's axes."""
    hh, bh, bb = moments
    straight = [_row(bb, bh, hh, list(range(axis + 1))) for axis in range(3)]
    for one in _CANDIDATES:
        rows = [straight[axis][j, int(s)] for axis, (j, s) in enumerate(zip(one.order, one.is_flipped, strict=True))]
        yield float(np.sqrt(np.sum(rows) / 3.0)), one, True
    turned = {order: [_row(bb, bh, hh, list(order[: axis + 1])) for axis in range(3)] for order in _ORDERS}
    for one in _CANDIDATES:
        rows = [turned[one.order][axis][axis, int(flipped)] for axis, flipped in enumerate(one.is_flipped)]
        yield float(np.sqrt(np.sum(rows) / 3.0)), one, False


def _row(bb: Floats, bh: Floats, hh: Floats, axes: list[int]) -> Floats:
    """Return the mean square, nT^2, that a row on the field's ``axes`` leaves, shape (3, 2).

    For each reading, straight and flipped; the gain to the last of the axes is not negative.
    """
    left = np.empty((2, 3))
    for k, taken in enumerate((axes, axes[:-1])):
        gains = np.linalg.solve(bb[np.ix_(taken, taken)], bh[taken]) if taken else np.zeros((0, 3))
        left[k] = np.maximum(hh - np.sum(bh[taken] * gains, axis=0), 0.0)
        if k == 0:
            own = gains[-1]
    return np.stack([np.where(own >= 0, left[0], left[1]), np.where(own <= 0, left[0], left[1])], axis=-1)

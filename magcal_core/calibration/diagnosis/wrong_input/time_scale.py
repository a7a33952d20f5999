"""Which time scale the telemetry's clock keeps: GPS, TAI or TT taken for UTC."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.diagnosis.wrong_input.scores import QuadricScore, residual_floor_nt
from magcal_core.numerics.robust import robust_sigma
from magcal_core.orbit.earth.timescales import tai_minus_utc_s

KNOWN_SCALES: Final[Mapping[str, str]] = {"gps": "GPS", "tai": "TAI", "tt": "TT"}
SCALE_RATIO: Final = 1.5
"""Drop of the residual from which another time scale is suspected.

18 s are 315 nT of |B| (17.5 nT/s): five times the residual would ask for 60 nT of noise. The claim is more specific:
one of three values within a second, out of a scan of +-75 s.
"""
_NEAR_S: Final = 1.0
_REACH_S: Final = 75.0
_STEP_S: Final = 1.0
_GAP_S: Final = 120.0
_MOST: Final = 600
_FEWEST: Final = 40
_TRIMS: Final = 6


@dataclass(frozen=True, slots=True)
class ScaleCandidate:
    """A time scale that fits better than UTC, and where a free scan puts the offset."""

    scale: str
    offset_s: float
    best_s: float
    before_nt: float
    after_nt: float

    @property
    def ratio(self) -> float:
        """By how much the residual would fall."""
        return self.before_nt / self.after_nt


def known_offsets_s(at_utc: np.datetime64) -> dict[str, float]:
    """Return by how much each scale of `KNOWN_SCALES` is ahead of UTC at ``at_utc``, s."""
    tai = float(tai_minus_utc_s(np.array([at_utc]))[0])
    return {"gps": tai - 19.0, "tai": tai, "tt": tai + 32.184}


def scale_of_offset(at_utc: np.datetime64, offset_s: float, error_s: float) -> str | None:
    """Return the scale that an estimated clock offset points at, None where it points at none.

    Within three standard errors, at least 0.3 and at most 1 s, of the scale's own offset.
    """
    reach = min(max(3.0 * error_s, 0.3), _NEAR_S)
    for scale, known in known_offsets_s(at_utc).items():
        if known > 0 and abs(offset_s - known) <= reach:
            return scale
    return None


def scan_scales(t_utc: Times, h_nt: Floats, b_nt: Floats) -> ScaleCandidate | None:
    """Return the time scale that ``t_utc`` seems to be in, None where UTC serves or the data cannot tell.

    Parameters
    ----------
    t_utc : shape (n,), ascending
    h_nt, b_nt : shape (n, 3), (n,)
        Reading and reference magnitude, nT, the latter taken at ``t_utc``.

    Notes
    -----
    The reference is moved along itself, B(t - offset), by interpolation between samples, and each offset is scored by
    the ten-unknown linear fit. An offset of the clock alone puts the minimum anywhere; a wrong scale puts it on the
    scale's own value.
    """
    t_s = (t_utc - t_utc[0]) / np.timedelta64(1, "ns") * 1e-9
    is_rising = t_s[1:] > t_s[:-1]
    if not is_rising.all():
        rising = np.concatenate([[True], is_rising])
        t_s, b_nt, h_nt = t_s[rising], b_nt[rising], h_nt[rising]
    index = _movable(t_s)
    if len(index) < _FEWEST:
        return None
    known = {scale: offset for scale, offset in known_offsets_s(t_utc[0]).items() if offset > 0}
    h_nt = h_nt[index]
    before, *after = _scores_nt(h_nt, _moved(t_s, b_nt, index, np.array([0.0, *known.values()])))
    if not after or before / min(after) < SCALE_RATIO:
        return None
    grid = np.arange(-_REACH_S, _REACH_S + _STEP_S / 2, _STEP_S)
    best = float(grid[int(np.argmin(_scores_nt(h_nt, _moved(t_s, b_nt, index, grid))))])
    scale, left = min(zip(known, after, strict=True), key=lambda pair: pair[1])
    if abs(best - known[scale]) > _NEAR_S:
        return None
    return ScaleCandidate(scale, known[scale], best, float(before), float(left))


def _scores_nt(h_nt: Floats, candidates_nt: Floats) -> Floats:
    """Return the residual, nT, of each candidate, shape (m,); samples that the best one cannot explain are left out."""
    near = np.ones(len(h_nt), dtype=bool)
    floor = residual_floor_nt(candidates_nt[:, 0])
    for _ in range(_TRIMS):
        score = QuadricScore(h_nt[near], candidates_nt[near, 0])
        residuals = score.residuals_nt(candidates_nt[near])
        best = int(np.argmin(np.median(np.abs(residuals), axis=0)))
        is_far = np.abs(residuals[:, best]) > 4.0 * robust_sigma(residuals[:, best], floor)
        if not is_far.any():
            break
        near[near] = ~is_far
    return np.asarray(np.hypot(np.sqrt(np.mean(residuals**2, axis=0)), floor))


def _movable(t_s: Floats) -> NDArray[np.intp]:
    """Return the samples, thinned, that stay `_REACH_S` clear of every gap and of both ends."""
    gaps = np.flatnonzero(t_s[1:] - t_s[:-1] > _GAP_S)
    starts, ends = t_s[np.concatenate([[0], gaps + 1])], t_s[np.concatenate([gaps, [len(t_s) - 1]])]
    first = np.searchsorted(t_s, starts + _REACH_S)
    counts = np.maximum(np.searchsorted(t_s, ends - _REACH_S, side="right") - first, 0)
    # The samples inside, counted through all arcs: every so many of them, without a list of all.
    until = np.cumsum(counts)
    at = np.arange(0, until[-1], max(1, int(until[-1]) // _MOST))
    arc = np.searchsorted(until, at, side="right")
    return np.asarray(first[arc] + at - (until - counts)[arc])


def _moved(t_s: Floats, b_nt: Floats, index: NDArray[np.intp], offsets_s: Floats) -> Floats:
    """Return B(t - offset) at the samples ``index``, shape (n, m), by cubic Hermite interpolation."""
    at = t_s[index][:, None] - offsets_s
    left = np.clip(np.searchsorted(t_s, at, side="right") - 1, 0, len(t_s) - 2)
    width = t_s[left + 1] - t_s[left]
    x = (at - t_s[left]) / width
    b0, b1 = b_nt[left], b_nt[left + 1]
    m0, m1 = _slopes(t_s, b_nt, left) * width, _slopes(t_s, b_nt, left + 1) * width
    moved: Floats = b0 + x * (m0 + x * (3 * (b1 - b0) - 2 * m0 - m1 + x * (2 * (b0 - b1) + m0 + m1)))
    return moved


def _slopes(t_s: Floats, b_nt: Floats, at: NDArray[np.intp]) -> Floats:
    """Return the slope of ``b_nt`` at the samples ``at``, nT/s, of the parabola through the neighbours.

    At an end, where only its value is asked for, that of the sample beside it.
    """
    at = np.clip(at, 1, len(t_s) - 2)
    ahead_s, behind_s = t_s[at + 1] - t_s[at], t_s[at] - t_s[at - 1]
    ahead = (b_nt[at + 1] - b_nt[at]) / ahead_s
    behind = (b_nt[at] - b_nt[at - 1]) / behind_s
    return np.asarray((ahead * behind_s + behind * ahead_s) / (ahead_s + behind_s))

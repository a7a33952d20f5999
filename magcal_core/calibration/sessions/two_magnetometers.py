"""Two magnetometers of one satellite compared after their calibration: direction, rotation, offset, gain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.diagnosis.affine import fit_affine
from magcal_core.calibration.diagnosis.mounting import rotation_vector
from magcal_core.errors import TooFewSamplesError

MIN_PAIRS: Final = 30
SIGNIFICANT: Final = 4.0
"""Standard errors from which a difference is called one: 0.1 % over the fifteen figures tested."""
_SAME_SHARE: Final = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedReadings:
    """Corrected readings of one magnetometer: times, datetime64[ns] UTC, shape (n,), and fields, nT, shape (n, 3)."""

    t_utc: Times
    b_nt: Floats


@dataclass(frozen=True, slots=True)
class AngleStatistics:
    """Statistics of the angle between two directions, deg."""

    mean_deg: float
    rms_deg: float
    max_deg: float

    @classmethod
    def between(cls, one: Floats, other: Floats) -> AngleStatistics:
        """Return those between vectors of shape (n, 3)."""
        sine = np.linalg.norm(np.cross(one, other), axis=1)
        angle = np.rad2deg(np.arctan2(sine, np.sum(one * other, axis=1)))
        return cls(float(angle.mean()), float(np.sqrt(np.mean(angle**2))), float(angle.max()))

    def to_dict(self) -> dict[str, float]:
        """Return the statistics as records have them."""
        return {"mean_deg": self.mean_deg, "rms_deg": self.rms_deg, "max_deg": self.max_deg}


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """How two magnetometers differ: first = (1 + G) R second + offset.

    Attributes
    ----------
    pairs : samples compared.
    rotation : shape (3, 3)
        R, from the second one's base frame to the first one's (the nearest one, by singular values).
    rotation_vector_deg, rotation_errors_deg : shape (3,)
    rotation_covariance_rad2 : shape (3, 3)
    offset_nt, offset_errors_nt : shape (3,)
        What remains constant: rest of the biases, and the satellite's own field between the two places.
    gradient_nt_per_m : shape (3,), optional
        The offset over the distance, where that was given.
    gain, gain_errors : shape (3, 3)
        G, symmetric: what remains in proportion to the field, of scale factors and angles.
    before, after : angle between the directions as calibrated, and with R, offset and G taken off.
    rms_before_nt, rms_after_nt : root mean square of a component of the difference, nT.
    """

    pairs: int
    rotation: Floats
    rotation_vector_deg: Floats
    rotation_errors_deg: Floats
    rotation_covariance_rad2: Floats
    offset_nt: Floats
    offset_errors_nt: Floats
    gradient_nt_per_m: Floats | None
    gain: Floats
    gain_errors: Floats
    before: AngleStatistics
    after: AngleStatistics
    rms_before_nt: float
    rms_after_nt: float
    findings: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the comparison as records have it."""
        arrays = (
            "rotation",
            "rotation_vector_deg",
            "rotation_errors_deg",
            "offset_nt",
            "offset_errors_nt",
            "gain",
            "gain_errors",
        )
        return {
            "pairs": self.pairs,
            **{name: getattr(self, name).tolist() for name in arrays},
            "gradient_nt_per_m": None if self.gradient_nt_per_m is None else self.gradient_nt_per_m.tolist(),
            "direction_before": self.before.to_dict(),
            "direction_after": self.after.to_dict(),
            "rms_before_nt": self.rms_before_nt,
            "rms_after_nt": self.rms_after_nt,
            "findings": list(self.findings),
        }


def compare_magnetometers(
    first: CorrectedReadings, second: CorrectedReadings, *, distance_m: float | None = None
) -> Comparison:
    """Return how two calibrated magnetometers of one satellite differ, with honest errors.

    Parameters
    ----------
    first, second : CorrectedReadings
        Ascending in time. Readings at the same times are paired; where the times differ, the second one is interpolated
        between neighbours (cubic Hermite), within its own gaps.
    distance_m : float, optional
        Distance between the two, m.

    Raises
    ------
    TooFewSamplesError
        Fewer than `MIN_PAIRS` pairs.

    Notes
    -----
    The affine map A of the second to the first is A = (1 + G) R with G symmetric and R the nearest rotation, by
    singular values as for Wahba's problem. Huber's loss: a spike of one sensor moves nothing. Noise of the second
    sensor lowers G by its variance over the field's, 25 ppm at 100 nT.
    """
    t_s, one, other = _paired(first, second)
    if len(one) < MIN_PAIRS:
        raise TooFewSamplesError(f"{len(one)} pairs of readings, the comparison needs at least {MIN_PAIRS}")
    affine = fit_affine(t_s, other, one, np.ones(len(one)), is_robust=True)
    u, s, vt = np.linalg.svd(affine.matrix)
    rotation = u @ vt
    hand = 1.0 if np.linalg.det(rotation) > 0 else -1.0
    gain = (u * s) @ u.T - np.eye(3)
    rotation_covariance = affine.matrix_covariance(_antisymmetric(rotation))
    gain_variances = np.diag(affine.matrix_covariance(_symmetric(rotation))).reshape(3, 3)
    vector_deg = np.rad2deg(rotation_vector(hand * rotation))
    errors_deg = np.rad2deg(np.sqrt(np.diag(rotation_covariance)))
    offset_errors = np.sqrt(np.diag(affine.offset_covariance))
    used = affine.weights > 0.5
    predicted = other @ affine.matrix.T + affine.offset
    gain_errors = np.sqrt(gain_variances)
    return Comparison(
        pairs=len(one),
        rotation=rotation,
        rotation_vector_deg=vector_deg,
        rotation_errors_deg=errors_deg,
        rotation_covariance_rad2=rotation_covariance,
        offset_nt=affine.offset,
        offset_errors_nt=offset_errors,
        gradient_nt_per_m=None if distance_m is None else affine.offset / distance_m,
        gain=gain,
        gain_errors=gain_errors,
        before=AngleStatistics.between(one[used], other[used]),
        after=AngleStatistics.between(one[used], predicted[used]),
        rms_before_nt=float(np.sqrt(np.mean((one - other)[used] ** 2))),
        rms_after_nt=float(np.sqrt(np.mean(affine.residuals[used] ** 2))),
        findings=_findings(
            hand,
            _Difference(vector_deg, errors_deg),
            _Difference(affine.offset, offset_errors),
            _Difference(gain, gain_errors),
        ),
    )


def _antisymmetric(rotation: Floats) -> Floats:
    """Return d w / d A, shape (3, 3, 3), with dA R^T = dG + [w x]."""
    out = np.zeros((3, 3, 3))
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        out[k, i] += 0.5 * rotation[j]
        out[k, j] -= 0.5 * rotation[i]
    return out


def _symmetric(rotation: Floats) -> Floats:
    """Return d G / d A, shape (9, 3, 3), row by row of G."""
    out = np.zeros((3, 3, 3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j, i] += 0.5 * rotation[j]
            out[i, j, j] += 0.5 * rotation[i]
    return out.reshape(9, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Difference:
    """What remains between two sensors: a rotation vector, deg, or an offset, nT, or gains, and their errors."""

    values: Floats
    errors: Floats

    @property
    def is_significant(self) -> bool:
        return bool(np.any(np.abs(self.values) > SIGNIFICANT * self.errors))

    @property
    def text(self) -> str:
        return f"{float(np.linalg.norm(self.values)):.3g} +- {float(self.errors.max()):.2g}"


def _findings(hand: float, turned: _Difference, offset: _Difference, gain: _Difference) -> tuple[str, ...]:
    found = ["left_handed: one of the two sensors is left-handed"] if hand < 0 else []
    if turned.is_significant:
        found.append(f"rotated: by {turned.text} deg against each other")
    if offset.is_significant:
        found.append(f"offset: {offset.text} nT remain between them")
    if gain.is_significant:
        found.append(f"gain: they differ by up to {float(np.abs(gain.values).max()):.2g} of the field")
    return tuple(found)


def _paired(first: CorrectedReadings, second: CorrectedReadings) -> tuple[Floats, Floats, Floats]:
    """Return the times, s, the first one's readings there and the second one's, each of shape (m, 3)."""
    start = first.t_utc[0] if len(first.t_utc) else np.datetime64(0, "ns")
    t1 = (first.t_utc - start) / np.timedelta64(1, "ns") * 1e-9
    t2 = (second.t_utc - start) / np.timedelta64(1, "ns") * 1e-9
    good1 = np.flatnonzero(np.isfinite(first.b_nt).all(axis=1))
    good2 = np.flatnonzero(np.isfinite(second.b_nt).all(axis=1) & np.concatenate([[True], np.diff(t2) > 0]))
    t1, b1, t2, b2 = t1[good1], first.b_nt[good1], t2[good2], second.b_nt[good2]
    if len(t2) < 4 or len(t1) < 4:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
    step = float(np.median(np.diff(t2)))
    left = np.clip(np.searchsorted(t2, t1, side="right") - 1, 0, len(t2) - 2)
    nearest = left + (t1 - t2[left] > t2[left + 1] - t1)
    is_same = np.abs(t2[nearest] - t1) <= _SAME_SHARE * step
    if np.count_nonzero(is_same) >= max(MIN_PAIRS, 0.5 * len(t1)):
        return t1[is_same], b1[is_same], b2[nearest[is_same]]
    width = t2[left + 1] - t2[left]
    inside = (t1 >= t2[0]) & (t1 <= t2[-1]) & (width <= 2.5 * step)
    return t1[inside], b1[inside], _hermite(t2, b2, t1[inside], left[inside])


def _hermite(t: Floats, b: Floats, at: Floats, left: NDArray[np.intp]) -> Floats:
    slope = np.gradient(b, t, axis=0)
    width = (t[left + 1] - t[left])[:, None]
    x = (at - t[left])[:, None] / width
    b0, b1, m0, m1 = b[left], b[left + 1], slope[left] * width, slope[left + 1] * width
    return np.asarray(b0 + x * (m0 + x * (3 * (b1 - b0) - 2 * m0 - m1 + x * (2 * (b0 - b1) + m0 + m1))))

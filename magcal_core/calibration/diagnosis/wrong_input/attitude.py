"""Which attitude was meant: inverse and scalar-last quaternions, and the inertial frame they refer to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import attitude_matrix, conjugate, rotate
from magcal_core.calibration.diagnosis.wrong_input.scores import affine_residuals_nt, affine_rms_nt
from magcal_core.numerics.robust import robust_sigma
from magcal_core.samples import Samples

QUATERNION_RATIO: Final = 1.5
"""Drop of the residual from which another quaternion convention is suspected, whatever became of the fit."""
DOUBTED_RATIO: Final = 1.1
"""The same where the fit found a dead axis, a turned frame or no result: right files reach 0.95 at most."""
NEAR_RATIO: Final = 1.15
"""Drop from which another inertial frame is suspected.

TEME and GCRF differ by precession and nutation, 0.3 deg in 2022: about 70 nT a component, which no sensor parameter and
no mounting can take up. A candidate without a free parameter that explains a quarter of the variance is no chance; a
fifth of the residual would ask for noise below 15 nT.
"""
_GROSS_SHARE: Final = 0.03
"""Share of the field that a wrong convention leaves at the least: below it only a neighbouring frame can be meant."""

_SAME_TURN: Final = 0.35
"""How near the turn that fits best must lie to the candidate's, as a share of it."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeCandidate:
    """The reading of the attitude that fits best: residuals, nT a component, and the field in its base frame."""

    name: str
    says: str
    threshold: float
    before_nt: float
    after_nt: float
    b_base_nt: Floats

    @property
    def ratio(self) -> float:
        """By how much the residual would fall."""
        return self.before_nt / self.after_nt


def best_attitude(samples: Samples, quaternion_ratio: float = QUATERNION_RATIO) -> AttitudeCandidate | None:
    """Return the best reading of the attitude, the one that was sent included; None without attitude.

    ``quaternion_ratio``: drop of the residual from which another convention of the quaternions is believed.

    Notes
    -----
    Each candidate is scored by the unconstrained linear fit of the reading to the field in its base frame: signed
    permutations and mounting rotations are absorbed, so only the attitude is judged.
    """
    q, sent = samples.q_base_gcrf, samples.b_ref_base_nt
    if q is None or sent is None:
        return None
    is_known = np.isfinite(q).all(axis=1) & (np.abs(np.linalg.norm(q, axis=1) - 1.0) < 1e-2)
    if np.count_nonzero(is_known) < 0.9 * len(samples):
        return None
    base = np.where(is_known[:, None], sent, np.nan)
    gcrf = samples.b_ref_gcrf_nt
    if gcrf is None:
        gcrf = np.einsum("nij,ni->nj", attitude_matrix(q), base)
    use = is_known & np.isfinite(gcrf).all(axis=1)
    h_nt = samples.h_nt[use]
    before = affine_rms_nt(h_nt, sent[use])
    is_gross = before > _GROSS_SHARE * float(np.mean(np.linalg.norm(gcrf[use], axis=1)))
    best = AttitudeCandidate("as sent", "the attitude is as it was sent", np.inf, before, before, sent)
    for name, says, candidate in _readings(q):
        b_base = rotate(candidate, gcrf)
        after = affine_rms_nt(h_nt, b_base[use])
        if before / after >= quaternion_ratio and after < best.after_nt:
            best = AttitudeCandidate(name, says, quaternion_ratio, before, after, b_base)
    if is_gross or best.threshold < np.inf:
        return best
    for name, says, b_base in _inertial_frames(samples, q, gcrf):
        after = affine_rms_nt(h_nt, b_base[use])
        is_better = before / after >= NEAR_RATIO and after < best.after_nt
        if is_better and _is_this_turn(h_nt, q[use], gcrf[use], b_base[use]):
            best = AttitudeCandidate(name, says, NEAR_RATIO, before, after, b_base)
    return best


def _is_this_turn(h_nt: Floats, q: Floats, gcrf: Floats, candidate: Floats) -> bool:
    """Return whether the turn of the inertial frame that fits best is the candidate's, of all small turns.

    ``candidate``: field in the base frame after the candidate's turn. Slow errors of the bias explain some turn in a
    short pass; that it is this very one, to `_SAME_TURN` of its size, they do not.
    """
    sent = rotate(q, gcrf)
    h_nt, rows = h_nt - h_nt.mean(axis=0), sent - sent.mean(axis=0)
    gains = np.linalg.lstsq(rows, h_nt, rcond=None)[0]
    errors = affine_residuals_nt(h_nt, sent)
    near = np.linalg.norm(errors, axis=1) <= 4.0 * robust_sigma(np.linalg.norm(errors, axis=1))
    moves = [affine_residuals_nt(rotate(q, np.cross(axis, gcrf)) @ gains, sent)[near].ravel() for axis in np.eye(3)]
    found = np.linalg.lstsq(np.column_stack(moves), errors[near].ravel(), rcond=None)[0]
    back = rotate(conjugate(q), candidate)
    meant = np.linalg.lstsq(
        np.concatenate([np.cross(axis, gcrf)[:, :, None] for axis in np.eye(3)], axis=2).reshape(-1, 3),
        (back - gcrf).ravel(),
        rcond=None,
    )[0]
    return bool(np.linalg.norm(found - meant) <= _SAME_TURN * np.linalg.norm(meant))


def _readings(q: Floats) -> Iterator[tuple[str, str, Floats]]:
    """Yield what else the quaternions may mean: name, words, quaternions."""
    rolled = np.roll(q, 1, axis=1)
    yield "inverse quaternions", "the quaternions seem to be the inverse ones (base to GCRF)", conjugate(q)
    yield "scalar-last quaternions", "the quaternions seem to be scalar-last", rolled
    both = "the quaternions seem to be scalar-last and inverse"
    yield "inverse scalar-last quaternions", both, conjugate(rolled)


def _inertial_frames(samples: Samples, q: Floats, gcrf: Floats) -> Iterator[tuple[str, str, Floats]]:
    """Yield what else the inertial frame may be: name, words, field in the base frame."""
    turn = _teme_to_gcrf(samples)
    yield "attitude from TEME", "the attitude seems to refer to TEME, not to GCRF", rotate(q, gcrf @ turn)
    reference = "the reference field seems to be in TEME, not in GCRF"
    yield "reference in TEME", reference, rotate(q, gcrf @ turn.T)


def _teme_to_gcrf(samples: Samples) -> Floats:
    """Return the rotation from TEME to GCRF in the middle of the samples, shape (3, 3)."""
    from magcal_core.orbit.earth.frames import rotation_matrix

    middle = samples.t_utc[len(samples) // 2 : len(samples) // 2 + 1]
    return np.asarray(rotation_matrix(middle, "TEME", "GCRF")[0])

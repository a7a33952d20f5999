"""Which frame the positions of the telemetry are in: inertial positions taken for Earth-fixed ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.wrong_input.scores import QuadricScore, residual_floor_nt
from magcal_core.errors import ModelRangeError
from magcal_core.field import FieldModel
from magcal_core.numerics.robust import robust_sigma
from magcal_core.samples import Samples

_FRAMES: Final[tuple[Literal["GCRF", "TEME"], ...]] = ("GCRF", "TEME")
_MOST: Final = 400


@dataclass(frozen=True, slots=True)
class PositionCandidate:
    """The frame that fits best, and the residuals of |B|, nT, with the frame that was sent and with this one."""

    name: str
    before_nt: float
    after_nt: float

    @property
    def ratio(self) -> float:
        """By how much the residual would fall."""
        return self.before_nt / self.after_nt


def best_position_frame(samples: Samples, b_nt: Floats, field: FieldModel) -> PositionCandidate | None:
    """Return the inertial frame in which the positions explain the readings best; None where none can be tried.

    Notes
    -----
    GCRF and TEME lie 0.3 deg apart, a few nT of |B|: which of the two is named decides a small difference, that it is
    not ITRF a large one.
    """
    from magcal_core.orbit.earth.frames import convert_position

    thin = samples.take(slice(None, None, max(1, len(samples) // _MOST)))
    sent = b_nt[:: max(1, len(samples) // _MOST)]
    if thin.r_itrf_km is None or not np.isfinite(thin.r_itrf_km).all():
        return None
    tried = []
    try:
        for frame in _FRAMES:
            r_itrf_km = convert_position(thin.t_utc, thin.r_itrf_km, frame, "ITRF")
            tried.append(np.linalg.norm(field.field_itrf_nt(thin.t_utc, r_itrf_km), axis=1))
    except ModelRangeError:
        return None
    candidates = np.column_stack([sent, *tried])
    floor = residual_floor_nt(sent)
    residuals = QuadricScore(thin.h_nt, sent).residuals_nt(candidates)
    left = [robust_sigma(column, floor) for column in residuals.T]
    best = 1 + int(np.argmin(left[1:]))
    return PositionCandidate(_FRAMES[best - 1], left[0], left[best])

"""What noise of the reading does to the scores of a session that is not linear in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.normal_equations import equations_at
from magcal_core.observations import Observations
from magcal_core.sensor.parameters import Parameters

_NOISE_STEP: Final = 1e-3
"""Step of the reading, as a share of the field, that derivatives of the scores are taken over."""


def noise_score(o: Observations, at: Parameters, score: Floats, *, is_vector: bool) -> Floats:
    """Return what noise of 1 nT in each component adds to the sum of scores, of ``score`` now, in the mean.

    Notes
    -----
    1/2 sum over axes of the second derivative of the score by the reading, by differences. |B| is not linear in the
    reading: where a session hardly shows a combination of parameters, noise moves it the same way in every sample. The
    residual of a vector calibration is linear, its derivatives have no noise.
    """
    if is_vector:
        return np.zeros_like(score)
    step_nt = _NOISE_STEP * float(o.b_nt.mean())
    total = np.zeros_like(score)
    for axis in range(3):
        for sign in (1.0, -1.0):
            moved = replace(o, h_nt=o.h_nt + sign * step_nt * np.eye(3)[axis])
            total += equations_at(moved, at, is_vector=False).gradient - score
    return np.asarray(0.5 * total / step_nt**2)

"""What becomes of simulated missions: whether error intervals hold and verdicts are right over a population."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.normal_equations import equations_at
from magcal_core.errors import EstimationError
from magcal_core.numerics.linear_algebra import floored_inverse
from magcal_core.numerics.sphere import even_directions
from magcal_core.observations import Observations
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.missions import Mission

TOLERANCE: Final = 0.03
"""Largest error of the corrected field over all directions, as a share of it, up to which a calibration is good.

3 % of the field are 1.7 deg of direction: what magnetic attitude determination and control can live with.
"""
FIELD_NT: Final = 40000.0
"""Field at which errors are taken, nT."""
_DIRECTIONS: Final = 200


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of one mission.

    Attributes
    ----------
    grade : str
        The verdict, or ``refuse`` where the calibration raised; ``code`` is the error's then.
    error_share : float
        Largest error of the corrected field over all directions, as a share of it; where there is no estimate, what an
        efficient one would have at 95 % (twice its standard error).
    is_covered : shape (9,), optional
        Whether each parameter's 95 % interval holds the truth.
    z : shape (9,), optional
        Error over standard error.
    reasons : codes of the verdict's reasons.
    """

    seed: int
    motion: str
    method: str
    grade: str
    code: str
    error_share: float
    is_covered: NDArray[np.bool_] | None
    z: Floats | None
    reasons: tuple[str, ...]

    @property
    def is_good(self) -> bool:
        """Whether the calibration serves (or would serve)."""
        return self.error_share <= TOLERANCE


def run_mission(mission: Mission) -> Outcome:
    """Return what the pipeline makes of a mission."""
    truth = effective_truth(mission)
    method = mission.options.method
    try:
        found = calibrate(mission.samples, mission.orbits, mission.options)
    except EstimationError as error:
        share = expected_share(mission, truth)
        return Outcome(mission.seed, mission.motion, method, "refuse", error.code, share, None, None, (error.code,))
    values = np.concatenate([truth.bias_nt, truth.scale, truth.nonorthogonality_deg])
    errors = found.standard_errors.vector[:9]
    z = (found.parameters.vector[:9] - values) / np.maximum(errors, 1e-300)
    reasons = tuple(reason.code for reason in found.verdict.reasons)
    share = largest_error_share(found.parameters, truth)
    is_covered = np.abs(z) <= 1.96
    return Outcome(mission.seed, mission.motion, method, found.verdict.grade, "", share, is_covered, z, reasons)


def effective_truth(mission: Mission) -> SensorModel:
    """Return the sensor with the session's mean of all that moves its bias: what a constant bias can be at best."""
    made = mission.simulation
    moved = made.samples.h_nt - mission.truth.apply(made.b_base_nt)
    rows = np.ones(len(moved), dtype=bool)
    outliers = made.truth["outlier_rows"]
    if isinstance(outliers, list) and outliers:
        rows[np.array(outliers)] = False
    bias = mission.truth.bias_nt + moved[rows].mean(axis=0)
    return SensorModel(bias, mission.truth.scale, mission.truth.nonorthogonality_deg)


def largest_error_share(parameters: Parameters, truth: SensorModel) -> float:
    """Return the largest error of the corrected field over all directions at `FIELD_NT`, as a share of it."""
    b_nt = FIELD_NT * even_directions(_DIRECTIONS)
    return float(np.linalg.norm(parameters.sensor.correct(truth.apply(b_nt)) - b_nt, axis=1).max() / FIELD_NT)


def expected_share(mission: Mission, truth: SensorModel) -> float:
    """Return twice the standard error of the corrected field, in its worst direction, of an efficient estimate.

    The Cramer-Rao bound at the truth with the reading's white noise alone: more than it no method can know.
    """

    is_vector = mission.options.method == "vector"
    observations = Observations.of(mission.simulation.samples_with_reference)
    at = Parameters(truth.bias_nt, truth.scale, truth.nonorthogonality_deg)
    normal = equations_at(observations, at, is_vector=is_vector).normal
    inverse = floored_inverse(normal, 1e-12)
    b_nt = FIELD_NT * even_directions(_DIRECTIONS)
    step = 1e-3 * np.sqrt(np.diag(inverse)) + 1e-9
    columns = []
    for i in range(9):
        nudged = at.vector.copy()
        nudged[i] += step[i]
        moved = at.with_vector(nudged)
        sensor = moved.matrix
        corrected = (truth.apply(b_nt) - moved.bias_nt) @ np.linalg.inv(sensor).T
        columns.append((corrected - b_nt) / step[i])
    jacobian = np.stack(columns, axis=-1)
    variances = np.einsum("nci,ij,ncj->n", jacobian, inverse, jacobian) * mission.sigma_nt**2
    return float(2.0 * np.sqrt(variances.max()) / FIELD_NT)


@dataclass(frozen=True, slots=True)
class Rates:
    """How often intervals hold and verdicts err.

    Attributes
    ----------
    coverage, coverage_accepted : share of 95 % intervals that hold the truth, of all estimates and of accepted ones.
    refused_good : share of the good ones that were refused; accepted_bad : share of the bad ones that were accepted.
    bad_among_accepted : share of the accepted ones that are bad: what an operator who trusts ``accept`` meets.
    """

    missions: int
    estimates: int
    accepted: int
    weak: int
    refused: int
    good: int
    coverage: float
    coverage_accepted: float
    refused_good: float
    accepted_bad: float
    bad_among_accepted: float


def rates_of(outcomes: Sequence[Outcome]) -> Rates:
    """Return the rates over ``outcomes``."""

    def share(part: Sequence[Outcome], whole: Sequence[Outcome]) -> float:
        return len(part) / len(whole) if whole else 0.0

    def coverage(of: Sequence[Outcome]) -> float:
        inside = [one.is_covered for one in of if one.is_covered is not None]
        return float(np.mean(inside)) if inside else 0.0

    accepted = [one for one in outcomes if one.grade == "accept"]
    refused = [one for one in outcomes if one.grade == "refuse"]
    good = [one for one in outcomes if one.is_good]
    bad = [one for one in outcomes if not one.is_good]
    bad_accepted = [one for one in accepted if not one.is_good]
    return Rates(
        missions=len(outcomes),
        estimates=sum(one.is_covered is not None for one in outcomes),
        accepted=len(accepted),
        weak=len(outcomes) - len(accepted) - len(refused),
        refused=len(refused),
        good=len(good),
        coverage=coverage(outcomes),
        coverage_accepted=coverage(accepted),
        refused_good=share([one for one in refused if one.is_good], good),
        accepted_bad=share(bad_accepted, bad),
        bad_among_accepted=share(bad_accepted, accepted),
    )

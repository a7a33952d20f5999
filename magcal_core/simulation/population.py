"""What becomes of simulated missions: whether error intervals hold and verdicts are right over a population."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Mask
from magcal_core.calibration.estimators.normal_equations import equations_at
from magcal_core.calibration.result import Calibration
from magcal_core.errors import EstimationError
from magcal_core.numerics.linear_algebra import floored_inverse
from magcal_core.numerics.sphere import even_directions
from magcal_core.observations import Observations
from magcal_core.pipeline import calibrate
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.electronics import cubic
from magcal_core.simulation.missions import Mission

TOLERANCE: Final = 0.03
"""Largest error of the corrected field over all directions, as a share of it, up to which a calibration is good.

3 % of the field are 1.7 deg of direction: what magnetic attitude determination and control can live with.
"""
FIELD_NT: Final = 40000.0
"""Field at which errors are taken, nT."""
STRAIGHT: Final = np.zeros(3)
"""How far a response bends that does not."""
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
        efficient one would have at 95 % (twice its standard error), infinite where there can be none.
    is_covered : shape (9,), optional
        Whether each parameter's 95 % interval holds the truth.
    is_mean_covered : shape (3,), optional
        The same of the bias where the record says that all rows of one light are left out, and the truth is the mean
        over the whole session; `is_covered` has the mean over the light that is kept.
    z : shape (9,), optional
        Error over standard error.
    distance : float, optional
        d' C^-1 d of the errors d with their covariance C: 9 in the mean where C is right.
    reasons : codes of the verdict's reasons.
    """

    seed: int
    kind: str
    motion: str
    method: str
    grade: str
    code: str
    error_share: float
    is_covered: NDArray[np.bool_] | None
    is_mean_covered: NDArray[np.bool_] | None
    z: Floats | None
    distance: float | None
    reasons: tuple[str, ...]

    @property
    def is_good(self) -> bool:
        """Whether the calibration serves (or would serve)."""
        return self.error_share <= TOLERANCE


def run_mission(mission: Mission) -> Outcome:
    """Return what the pipeline makes of a mission."""
    method = mission.options.method
    said = (mission.seed, mission.kind, mission.motion, method)
    try:
        found = calibrate(mission.samples, mission.orbits, mission.options)
    except EstimationError as error:
        share = expected_share(mission, effective_truth(mission)) if mission.is_determined else np.inf
        return Outcome(*said, "refuse", error.code, share, None, None, None, None, (error.code,))
    kept = _kept_rows(mission, found)
    truth = effective_truth(mission, kept)
    errors = found.standard_errors.vector[:9]
    away = found.parameters.vector[:9] - _vector(truth)
    z = away / np.maximum(errors, 1e-300)
    reasons = tuple(reason.code for reason in found.verdict.reasons)
    share = largest_error_share(found.parameters, biased_truth(mission, kept), mission.cubic_share)
    is_covered = np.abs(z) <= 1.96
    of_mean = found.parameters.bias_nt - effective_truth(mission).bias_nt
    is_mean_covered = None if kept is None else np.abs(of_mean) <= 1.96 * errors[:3]
    distance = float(away @ np.linalg.pinv(found.covariance[:9, :9], hermitian=True) @ away)
    grade = found.verdict.grade
    return Outcome(*said, grade, "", share, is_covered, is_mean_covered, z, distance, reasons)


def _vector(sensor: SensorModel) -> Floats:
    return np.concatenate([sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg])


def _kept_rows(mission: Mission, found: Calibration) -> Mask | None:
    """Return the rows of the light that is kept, where the record says that all rows of the other are left out."""
    said = [warning for warning in found.warnings if warning.startswith("odd_light:")]
    if not said or mission.light is None:
        return None
    return np.asarray((mission.light < 0.5) == ("rows in the sun are left out" in said[0]))


def biased_truth(mission: Mission, rows: Mask | None = None) -> SensorModel:
    """Return the sensor with the mean of all that moves its bias, over the readings that tell of the field."""
    chosen = mission.is_sound if rows is None else mission.is_sound & rows
    bias = mission.truth.bias_nt + mission.moved_nt[chosen if chosen.any() else slice(None)].mean(axis=0)
    return SensorModel(bias, mission.truth.scale, mission.truth.nonorthogonality_deg)


def effective_truth(mission: Mission, rows: Mask | None = None) -> SensorModel:
    """Return what nine parameters can be at best: a constant bias, and a straight line for a response that bends.

    ``rows``, shape (n,): those over which the bias is averaged; None: all that tell of the field.
    """
    truth = biased_truth(mission, rows)
    if not mission.cubic_share.any():
        return truth
    straight_nt = truth.apply(mission.b_base_nt)
    bent_nt = cubic(straight_nt, mission.cubic_share) - straight_nt
    matrix, bias_nt = truth.matrix.copy(), truth.bias_nt.copy()
    for i in range(3):
        columns = np.column_stack([mission.b_base_nt[:, : i + 1], np.ones(len(bent_nt))])
        line = np.linalg.lstsq(columns[mission.is_sound], bent_nt[mission.is_sound, i])[0]
        matrix[i, : i + 1] += line[:-1]
        bias_nt[i] += line[-1]
    return SensorModel.from_matrix(bias_nt, matrix)


def largest_error_share(parameters: Parameters, truth: SensorModel, cubic_share: Floats = STRAIGHT) -> float:
    """Return the largest error of the corrected field over all directions at `FIELD_NT`, as a share of it.

    ``cubic_share``, shape (3,): how far the response of the sensor bends.
    """
    b_nt = FIELD_NT * even_directions(_DIRECTIONS)
    corrected_nt = parameters.sensor.correct(cubic(truth.apply(b_nt), cubic_share))
    return float(np.linalg.norm(corrected_nt - b_nt, axis=1).max() / FIELD_NT)


def expected_share(mission: Mission, truth: SensorModel) -> float:
    """Return twice the standard error of the corrected field, in its worst direction, of an efficient estimate.

    The Cramer-Rao bound at the truth with the reading's white noise alone: more than it no method can know.
    """
    is_vector = mission.options.method == "vector"
    magnitude = np.linalg.norm(mission.b_base_nt, axis=1)
    known = replace(mission.samples, b_ref_base_nt=mission.b_base_nt, b_ref_magnitude_nt=magnitude)
    observations = Observations.of(known.take(mission.is_sound))
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
    good_refused : good ones that were refused.
    bad_accepted : accepted ones that are bad; ``bad_among_accepted`` is their share of the accepted: what an operator
        who trusts ``accept`` meets.
    distance_median, distance_mean : of d' C^-1 d, which are 8.3 and 9 where covariances are right.
    """

    missions: int
    estimates: int
    accepted: int
    weak: int
    refused: int
    good: int
    coverage: float
    coverage_accepted: float
    good_refused: int
    bad_accepted: int
    bad_among_accepted: float
    distance_median: float
    distance_mean: float


def rates_of(outcomes: Sequence[Outcome]) -> Rates:
    """Return the rates over ``outcomes``."""

    def coverage(of: Sequence[Outcome]) -> float:
        inside = [one.is_covered for one in of if one.is_covered is not None]
        return float(np.mean(inside)) if inside else 0.0

    accepted = [one for one in outcomes if one.grade == "accept"]
    refused = [one for one in outcomes if one.grade == "refuse"]
    bad_accepted = sum(not one.is_good for one in accepted)
    distances = [one.distance for one in outcomes if one.distance is not None]
    return Rates(
        missions=len(outcomes),
        estimates=sum(one.is_covered is not None for one in outcomes),
        accepted=len(accepted),
        weak=len(outcomes) - len(accepted) - len(refused),
        refused=len(refused),
        good=sum(one.is_good for one in outcomes),
        coverage=coverage(outcomes),
        coverage_accepted=coverage(accepted),
        good_refused=sum(one.is_good for one in refused),
        bad_accepted=bad_accepted,
        bad_among_accepted=bad_accepted / max(len(accepted), 1),
        distance_median=float(np.median(distances)) if distances else 0.0,
        distance_mean=float(np.mean(distances)) if distances else 0.0,
    )


def by_kind(outcomes: Sequence[Outcome]) -> list[tuple[str, Rates]]:
    """Return the rates of each kind, the worst first: bad ones accepted before intervals that do not hold."""
    kinds = {one.kind: [other for other in outcomes if other.kind == one.kind] for one in outcomes}
    rates = [(kind, rates_of(of)) for kind, of in kinds.items()]
    return sorted(rates, key=lambda one: (-one[1].bad_accepted, not one[1].estimates, one[1].coverage))

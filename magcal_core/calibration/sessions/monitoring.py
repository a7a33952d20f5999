"""Monitoring without refitting: a new session judged against the active calibration by one Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.normal_equations import block_equations
from magcal_core.calibration.estimators.scale_terms import without_scale_terms
from magcal_core.calibration.reasons import Reason
from magcal_core.calibration.sessions.consistency import ParameterDifference
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance
from magcal_core.errors import InputError, OptionError
from magcal_core.numerics.blocks import BlockScores
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.model import matrix_of_parameters
from magcal_core.sensor.parameters import Parameters

MIN_SAMPLES: Final = 12
SIGNIFICANT_P: Final = 1e-3
"""Probability, over all parameters, below which a drift is believed: one false alarm in a thousand sessions."""
WATCH_RATIO: Final = 2.0
BROKEN_RATIO: Final = 4.0
"""Residual over that of the active calibration from which a session is watched, and from which it disagrees."""
MATERIAL_SHARE: Final = 0.01
"""Change of the corrected field, as a share of it, from which a significant drift is more than a curiosity."""
_BLOCKS: Final = 64
_PRIOR: Final[Mapping[str, float]] = {"bias_nt": 2e4, "scale": 0.3, "nonorthogonality_deg": 20.0}
"""How far a parameter may have drifted at all: only there to keep what a session does not show from running away."""
_DIRECTIONS: Final = 64


@dataclass(frozen=True, slots=True, eq=False)
class ActiveSet:
    """The calibration in force: parameters, honest covariance in the order of their names, residual RMS, nT."""

    parameters: Parameters
    covariance: Floats
    residual_rms_nt: float
    is_vector: bool

    @classmethod
    def from_record(cls, record: Mapping[str, object]) -> ActiveSet:
        """Return the active set in a parameter set's record.

        Raises
        ------
        InputError
            The record lacks what a parameter set has.
        """
        try:
            values, statistics = record["parameters"], record["statistics"]
            if not isinstance(values, Mapping) or not isinstance(statistics, Mapping):
                raise InputError("the record is no parameter set: parameters and statistics are not mappings")
            bias, scale, angles = (np.array(values[group], np.float64) for group in _PRIOR)
            clock = values.get("time_offset_s")
            slopes = {name: np.array(slope, np.float64) for name, slope in dict(values.get("regressors", {})).items()}
            parameters = Parameters(bias, scale, angles, None if clock is None else float(clock), slopes)
            covariance = np.array(record["covariance"], np.float64)
            rms_nt = float(statistics["after"]["rms_nt"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the record is no parameter set: {error}") from error
        return cls(parameters, covariance, rms_nt, str(record.get("method", "")).startswith("vector"))


@dataclass(frozen=True, slots=True, eq=False)
class SessionMoments:
    """What is kept of a session to judge it again without its samples: its normal equations at some parameters.

    Attributes
    ----------
    at : the parameters (without clock) that the sums were taken at.
    blocks : scores and normal matrices of short blocks, in those parameters.
    samples, duration_s, cost, mean_nt, rms_nt, mean_field_nt
        Count; time that they cover, s; sum of squares, nT^2; mean and RMS of the residual, and mean |B|, nT.
    """

    at: Parameters
    blocks: BlockScores
    samples: int
    duration_s: float
    cost: float
    mean_nt: float
    rms_nt: float
    mean_field_nt: float


@dataclass(frozen=True, slots=True, eq=False)
class SessionJudgement:
    """What is said of a session against the active calibration.

    Attributes
    ----------
    grade : str
        ``agrees``, ``watch``, ``disagrees``, or ``too_short``.
    residual_rms_nt, residual_mean_nt, residual_ratio
        Of the session under the active parameters, and its RMS over the active calibration's own.
    drifts : tuple of ParameterDifference
        Each parameter: session - active, with an honest standard error (both sides), most significant first.
    field_change_nt, field_change_error_nt
        The drift as a change of the corrected field, root mean square over all directions at the mean |B|.
    p_value : float
        Of the most significant drift, over all parameters (Bonferroni).
    """

    grade: str
    reasons: tuple[Reason, ...]
    samples: int
    residual_rms_nt: float
    residual_mean_nt: float
    residual_ratio: float
    drifts: tuple[ParameterDifference, ...]
    field_change_nt: float
    field_change_error_nt: float
    p_value: float

    def to_dict(self) -> dict[str, object]:
        """Return the judgement as records have it."""
        return {
            "grade": self.grade,
            "reasons": [f"{reason.code}: {reason.text}" for reason in self.reasons],
            "samples": self.samples,
            "residual_rms_nt": self.residual_rms_nt,
            "residual_mean_nt": self.residual_mean_nt,
            "residual_ratio": self.residual_ratio,
            "p_value": self.p_value,
            "field_change_nt": self.field_change_nt,
            "field_change_error_nt": self.field_change_error_nt,
            "drifts": [drift.to_dict() for drift in self.drifts],
        }


def moments_of(observations: Observations, parameters: Parameters, *, is_vector: bool) -> SessionMoments:
    """Return a session's normal equations at ``parameters``, whose regressors the observations must have.

    Raises
    ------
    OptionError
        A regressor of the parameters is missing in the observations.
    """
    missing = [name for name in parameters.regressors if name not in observations.regressors]
    if missing:
        raise OptionError(f"the session has no column {missing[0]!r}, which the active parameters need")
    # Whether the scale's changes have changed in turn is not asked.
    bare, known = without_scale_terms(observations, parameters)
    o = bare.with_regressors(list(known.regressors))
    at = Parameters(known.bias_nt, known.scale, known.nonorthogonality_deg, None, known.regressors)
    whole, blocks = block_equations(o, at, is_vector=is_vector, blocks=_BLOCKS)
    r = residuals_nt(o, at, is_vector)
    used = o.weights > 0
    return SessionMoments(
        at=at,
        blocks=blocks,
        samples=int(np.count_nonzero(used)),
        duration_s=covered_s(o.t_s),
        cost=whole.cost,
        mean_nt=float(r[used].mean()),
        rms_nt=float(np.sqrt(np.mean(r[used] ** 2))),
        mean_field_nt=float(o.b_nt[used].mean()),
    )


def judge_session(observations: Observations, active: ActiveSet) -> SessionJudgement:
    """Return what a new session says of the active calibration; nothing is refitted.

    ``observations``: with the reference at the active set's own time offset and with its regressors.
    """
    return judge_moments(moments_of(observations, active.parameters, is_vector=active.is_vector), active)


def judge_moments(moments: SessionMoments, active: ActiveSet) -> SessionJudgement:
    """Return the judgement from stored moments.

    Notes
    -----
    One Gauss-Newton step -N^-1 g from the active parameters, its honest covariance from the blocks, plus the active
    set's own. A prior 10 to 100 times wider than any drift keeps what the session does not show from running away: its
    error is then as wide.
    """
    p = len(moments.at.vector)
    if moments.samples < MIN_SAMPLES:
        reason = Reason("insufficient_samples", f"{moments.samples} samples, {MIN_SAMPLES} are needed")
        return _judgement("too_short", (reason,), moments, active, _Drift((), 0.0, 0.0, 1.0))
    step, covariance = _step(moments)
    total = covariance + active.covariance[:p, :p]
    drifts = differences_of(moments.at.names, step, total, "session")
    size_nt, error_nt = field_change(moments.at, moments.mean_field_nt, step, total)
    drift = _Drift(drifts, size_nt, error_nt, min(1.0, p * drifts[0].p_value))
    reasons, grade = _reasons(moments, active, drift)
    return _judgement(grade, tuple(reasons), moments, active, drift)


@dataclass(frozen=True, slots=True)
class _Drift:
    """The drift parameter by parameter, as a change of the field with its error, nT, and its probability."""

    parameters: tuple[ParameterDifference, ...]
    size_nt: float
    error_nt: float
    p_value: float


def _judgement(
    grade: str, reasons: tuple[Reason, ...], moments: SessionMoments, active: ActiveSet, drift: _Drift
) -> SessionJudgement:
    return SessionJudgement(
        grade,
        reasons,
        moments.samples,
        moments.rms_nt,
        moments.mean_nt,
        _ratio(moments, active),
        drift.parameters,
        drift.size_nt,
        drift.error_nt,
        drift.p_value,
    )


def _ratio(moments: SessionMoments, active: ActiveSet) -> float:
    return moments.rms_nt / max(active.residual_rms_nt, 1e-9 * moments.mean_field_nt)


def _step(moments: SessionMoments) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step and its honest covariance."""
    blocks = moments.blocks
    normal, gradient = blocks.normals.sum(axis=0), blocks.scores.sum(axis=0)
    p = gradient.size
    groups = [name.split("[", maxsplit=1)[0] for name in moments.at.names]
    slopes = {f"regressors.{name}": 10.0 * float(np.abs(s).max()) + 1.0 for name, s in moments.at.regressors.items()}
    widths = np.array([(dict(_PRIOR) | slopes)[group] for group in groups])
    loose = np.diag(1.0 / widths**2)
    # The residual's variance enters the prior's weight, and the prior hardly enters the variance: two rounds settle it.
    variance, step = moments.cost / moments.samples, np.zeros(p)
    for _ in range(2):
        total = normal + variance * loose
        step = -_solve(total, gradient)
        left = moments.cost + 2.0 * gradient @ step + step @ normal @ step
        variance = max(float(left) / max(moments.samples - p, 1), 1e-12 * moments.cost / moments.samples, 1e-300)
    inverse = _solve(total, np.eye(p))
    after = blocks.scores + blocks.normals @ step
    settled = BlockScores(
        np.concatenate([after, np.zeros((1, p))]),
        np.concatenate([blocks.normals, variance * loose[None]]),
        np.concatenate([blocks.starts, [moments.samples]]),
        np.eye(p),
    )
    return step, honest_covariance(settled, inverse * variance, moments.samples, moments.duration_s).covariance


def _solve(normal: Floats, right: Floats) -> Floats:
    size = np.sqrt(np.diag(normal))
    scaled = right / size if right.ndim == 1 else right / size[:, None]
    found = np.linalg.solve(normal / np.outer(size, size), scaled)
    return np.asarray(found / size if right.ndim == 1 else found / size[:, None])


def differences_of(
    names: Sequence[str], step: Floats, covariance: Floats, second: str
) -> tuple[ParameterDifference, ...]:
    """Return the ``step`` from the active parameters to those of ``second``, the most significant first."""
    from scipy.special import ndtr

    errors = np.sqrt(np.diag(covariance))
    found = [
        ParameterDifference(name, "active", second, float(d), float(e), float(2.0 * ndtr(-abs(d) / max(e, 1e-300))))
        for name, d, e in zip(names, step, errors, strict=True)
    ]
    return tuple(sorted(found, key=lambda one: -one.sigmas))


def field_change(at: Parameters, mean_field_nt: float, step: Floats, covariance: Floats) -> tuple[float, float]:
    """Return the change of the corrected field by ``step`` and its error, nT, root mean square over directions.

    ``step`` and ``covariance``: in the order of `Parameters.names`, of which the first nine count.
    """
    b_nt = mean_field_nt * _sphere()
    angles_deg, scale = at.nonorthogonality_deg, at.scale
    matrix = matrix_of_parameters(scale, np.deg2rad(angles_deg))
    inverse = np.linalg.inv(matrix)
    columns = [np.tile(inverse[:, i], (len(b_nt), 1)) for i in range(3)]
    for i in range(3):
        row = np.zeros((3, 3))
        row[i] = matrix[i] / scale[i]
        columns.append(b_nt @ (inverse @ row).T)
    for i in range(3):
        nudged = angles_deg.copy()
        nudged[i] += 1e-3
        slope = (matrix_of_parameters(scale, np.deg2rad(nudged)) - matrix) / 1e-3
        columns.append(b_nt @ (inverse @ slope).T)
    jacobian = np.stack(columns, axis=-1).reshape(-1, 9)
    count = len(b_nt)
    size = float(np.sqrt(np.sum((jacobian @ step[:9]) ** 2) / count))
    error = float(np.sqrt(max(np.einsum("ij,jk,ik->", jacobian, covariance[:9, :9], jacobian), 0.0) / count))
    return size, error


def _sphere() -> Floats:
    turns = np.arange(_DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * turns / _DIRECTIONS
    angle = turns * np.pi * (1.0 + np.sqrt(5.0))
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _reasons(moments: SessionMoments, active: ActiveSet, drift: _Drift) -> tuple[list[Reason], str]:
    limit_nt = max(active.residual_rms_nt, MATERIAL_SHARE * moments.mean_field_nt)
    ratio, worst = _ratio(moments, active), drift.parameters[0]
    found: list[tuple[str, Reason]] = []
    if drift.p_value < SIGNIFICANT_P:
        text = (
            f"{worst.parameter} by {worst.difference:+.4g}, {worst.sigmas:.1f} sigma; the corrected field changes by "
            f"{drift.size_nt:.0f} +- {drift.error_nt:.0f} nT, limit {limit_nt:.0f} nT"
        )
        found.append(("disagrees" if drift.size_nt > limit_nt else "watch", Reason("parameter_drift", text)))
    if ratio >= WATCH_RATIO:
        limit = BROKEN_RATIO if ratio >= BROKEN_RATIO else WATCH_RATIO
        text = f"{moments.rms_nt:.0f} nT, {ratio:.2g} times that of the active calibration, limit {limit:g}"
        found.append(("disagrees" if ratio >= BROKEN_RATIO else "watch", Reason("residual_rms", text)))
    grades = {grade for grade, _ in found}
    grade = "disagrees" if "disagrees" in grades else "watch" if "watch" in grades else "agrees"
    if not found:
        text = f"RMS {moments.rms_nt:.0f} nT, largest drift {worst.sigmas:.1f} sigma in {worst.parameter}"
        found = [("agrees", Reason("consistent", text))]
    return [reason for _, reason in found], grade

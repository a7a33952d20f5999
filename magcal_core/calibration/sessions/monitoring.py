"""Monitoring without refitting: a new session judged against the active calibration by one Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.normal_equations import block_equations, equations_at
from magcal_core.calibration.estimators.registry import is_vector_method
from magcal_core.calibration.estimators.scale_terms import without_scale_terms
from magcal_core.calibration.reasons import Reason
from magcal_core.calibration.sessions.consistency import ParameterDifference
from magcal_core.calibration.sessions.field_change import field_change
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, honest_covariance
from magcal_core.errors import InputError, OptionError
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import scaled_solution
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import BEFORE, is_step

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
_NOISE_STEP: Final = 1e-3
"""Step of the reading, as a share of the field, that derivatives of the scores are taken over."""


@dataclass(frozen=True, slots=True, eq=False)
class ActiveSet:
    """The calibration in force: parameters, honest covariance in the order of their names, residual RMS, nT."""

    parameters: Parameters
    covariance: Floats
    residual_rms_nt: float
    is_vector: bool

    def values_of(self, names: Sequence[str]) -> Floats:
        """Return the parameters ``names``, which the set must have, in that order."""
        return self.parameters.vector[self._places(names)]

    def covariance_of(self, names: Sequence[str]) -> Floats:
        """Return the covariance of the parameters ``names``, which the set must have, in that order."""
        at = self._places(names)
        return self.covariance[np.ix_(at, at)]

    def at_time_base(self, time_base_utc: np.datetime64 | None) -> ActiveSet:
        """Return the set with the regressor ``time`` counted since another instant, where it has that regressor."""
        if time_base_utc is None or self.parameters.time_base_utc is None:
            return self
        at = self.parameters.vector
        steps = np.maximum(np.sqrt(np.abs(np.diag(self.covariance))), 1e-6 * np.maximum(np.abs(at), 1.0))

        def moved(values: Floats) -> Floats:
            return self.parameters.with_vector(values).at_time_base(time_base_utc).vector

        nudges = zip(0.5 * np.diag(steps), steps, strict=True)
        carry = np.column_stack([(moved(at + nudge) - moved(at - nudge)) / step for nudge, step in nudges])
        return replace(
            self,
            parameters=self.parameters.at_time_base(time_base_utc),
            covariance=carry @ self.covariance @ carry.T,
        )

    def _places(self, names: Sequence[str]) -> list[int]:
        own = self.parameters.names
        return [own.index(name) for name in names]

    @classmethod
    def from_record(cls, record: Mapping[str, object]) -> ActiveSet:
        """Return the active set in a parameter set's record.

        Raises
        ------
        InputError
            The record lacks what a parameter set has.
        """
        parameters = Parameters.from_record(record)
        if len(parameters.regressors) > 1 and "parameter_names" not in record:
            raise InputError("the record is no parameter set: no parameter_names, which the covariance is ordered by")
        try:
            statistics = record["statistics"]
            if not isinstance(statistics, Mapping):
                raise InputError("the record is no parameter set: statistics are not a mapping")
            covariance = np.array(record["covariance"], np.float64)
            slopes = parameters.regressors
            if any(map(is_step, slopes)):
                # What the bias was before a step inside its own data says nothing of others.
                told = [not name.startswith(f"regressors.{BEFORE}") for name in parameters.names]
                covariance = covariance[np.ix_(told, told)]
                kept = {name: slope for name, slope in slopes.items() if not is_step(name)}
                parameters = replace(parameters, regressors=kept)
            rms_nt = float(statistics["after"]["rms_nt"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the record is no parameter set: {error}") from error
        return cls(parameters, covariance, rms_nt, is_vector_method(record.get("method")))


@dataclass(frozen=True, slots=True, eq=False)
class SessionMoments:
    """What is kept of a session to judge it again without its samples: its normal equations at some parameters.

    Attributes
    ----------
    at : the parameters (without clock) that the sums were taken at.
    blocks : scores and normal matrices of short blocks, in those parameters.
    noise_score : shape (p,)
        What noise of 1 nT in each component adds to the sum of the scores in the mean, 1/nT^2.
    samples, duration_s, cost, mean_nt, rms_nt, mean_field_nt
        Count; time that they cover, s; sum of squares, nT^2; mean and RMS of the residual, and mean |B|, nT.
    """

    at: Parameters
    blocks: BlockScores
    noise_score: Floats
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
        noise_score=_noise_score(o, at, whole.gradient, is_vector=is_vector),
        samples=int(np.count_nonzero(used)),
        duration_s=covered_s(o.t_s),
        cost=whole.cost,
        mean_nt=float(r[used].mean()),
        rms_nt=float(np.sqrt(np.mean(r[used] ** 2))),
        mean_field_nt=float(o.b_nt[used].mean()),
    )


def _noise_score(o: Observations, at: Parameters, score: Floats, *, is_vector: bool) -> Floats:
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
    rows = moments.samples * (3 if active.is_vector else 1)
    step, covariance = _step(moments, rows)
    total = covariance + active.covariance_of(moments.at.names)
    drifts = differences_of(moments.at.names, step, total, "session", _freedom(covariance, total, rows - p))
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


def _freedom(own: Floats, total: Floats, rows: int) -> Floats:
    """Return the degrees of freedom of each error of ``total``, of which the part ``own`` has ``rows`` of them.

    Notes
    -----
    Welch and Satterthwaite, (sum of variances)^2 / sum of (variance^2 / freedom), with the active set's own variance
    taken for known: a session of 12 samples has three residuals to tell its noise from, and a drift of nine parameters
    that is believed once in a thousand is then one of 28 standard errors, not of 4.
    """
    return np.asarray(max(rows, 1) * (np.diag(total) / np.maximum(np.diag(own), 1e-300)) ** 2)


def _step(moments: SessionMoments, rows: int) -> tuple[Floats, Floats]:
    """Return the Gauss-Newton step and its honest covariance; ``rows``: number of residuals."""
    blocks = moments.blocks
    normal, gradient = blocks.normals.sum(axis=0), blocks.scores.sum(axis=0)
    p = gradient.size
    groups = [name.split("[", maxsplit=1)[0] for name in moments.at.names]
    slopes = {f"regressors.{name}": 10.0 * float(np.abs(s).max()) + 1.0 for name, s in moments.at.regressors.items()}
    widths = np.array([(dict(_PRIOR) | slopes)[group] for group in groups])
    loose = np.diag(1.0 / widths**2)
    # The residual's variance enters the prior's weight, and the prior hardly enters the variance: two rounds settle it.
    variance, step = moments.cost / rows, np.zeros(p)
    for _ in range(2):
        total = normal + variance * loose
        step = -scaled_solution(total, gradient)
        left = moments.cost + 2.0 * gradient @ step + step @ normal @ step
        variance = max(float(left) / max(rows - p, 1), 1e-12 * moments.cost / rows, 1e-300)
    inverse = scaled_solution(total, np.eye(p))
    after = blocks.scores + blocks.normals @ step
    settled = BlockScores(
        np.concatenate([after, np.zeros((1, p))]),
        np.concatenate([blocks.normals, variance * loose[None]]),
        np.concatenate([blocks.starts, [moments.samples]]),
        np.eye(p),
    )
    honest = honest_covariance(settled, inverse * variance, moments.samples, moments.duration_s).covariance
    shift = inverse @ moments.noise_score * variance
    return step, honest + np.outer(shift, shift)


def differences_of(
    names: Sequence[str], step: Floats, covariance: Floats, second: str, freedom: Floats | None = None
) -> tuple[ParameterDifference, ...]:
    """Return the ``step`` from the active parameters to those of ``second``, the most significant first.

    ``freedom``: degrees of freedom of each error, shape (p,), for Student's t; the normal law unless given.
    """
    from scipy.special import ndtr, stdtr

    errors = np.sqrt(np.diag(covariance))
    sigmas = np.abs(step) / np.maximum(errors, 1e-300)
    tails = 2.0 * (ndtr(-sigmas) if freedom is None else stdtr(freedom, -sigmas))
    found = [
        ParameterDifference(name, "active", second, float(d), float(e), float(p))
        for name, d, e, p in zip(names, step, errors, tails, strict=True)
    ]
    return tuple(sorted(found, key=lambda one: (one.p_value, -one.sigmas)))


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

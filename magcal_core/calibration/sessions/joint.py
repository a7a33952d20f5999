"""One calibration from several sessions: some parameters shared by all, the others each session's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitSettings
from magcal_core.calibration.estimators.loss import AUTO, AUTO_LOSS, fit_under_loss
from magcal_core.calibration.estimators.normal_equations import block_sums, equations_at
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.calibration.estimators.vector import VectorFit
from magcal_core.calibration.sessions.consistency import INCONSISTENT_P, Consistency, consistency_of_fits
from magcal_core.calibration.sessions.hidden_errors import HiddenErrors, Surrounded, hidden_errors
from magcal_core.calibration.sessions.joint_errors import JointBlocks, joint_honest_covariance, pieces_of, with_hidden
from magcal_core.calibration.uncertainty.honest_covariance import covered_s
from magcal_core.errors import EstimationError, Fault, NotObservableError, OptionError
from magcal_core.numerics.blocks import block_starts
from magcal_core.numerics.bordered import BlockAndLowRank, Bordered, Split
from magcal_core.numerics.bordered_search import BorderedMinimum, Sums, minimise_bordered
from magcal_core.numerics.robust import robust_sigma, weights_and_slopes
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameters import Parameters

DEFAULT_SHARED: Final = ("scale", "nonorthogonality_deg")
"""What does not change between sessions of one sensor: its axes. The bias does, with what is switched on near it."""
MOST_IN_RECORD: Final = 300
"""Most unknowns whose covariance a record has whole; each session's standard errors it always has."""
_BLOCKS: Final = 256
_ROUNDS: Final = 30


@dataclass(frozen=True, slots=True, eq=False)
class JointSession:
    """What the joint fit says of one session."""

    label: str
    parameters: Parameters
    standard_errors: Parameters
    samples: int
    sigma_nt: float

    def to_dict(self) -> dict[str, object]:
        """Return the session's part as records have it."""
        return {
            "label": self.label,
            "parameters": self.parameters.to_dict(),
            "standard_errors": self.standard_errors.to_dict(),
            "samples": self.samples,
            "sigma_nt": self.sigma_nt,
        }


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """A joint calibration.

    Attributes
    ----------
    names : names of the unknowns; a session's own ones are ``label:name``.
    values : shape (q,)
    errors : the honest covariance as it is kept: block-diagonal and of low rank.
    consistency : test of the sessions calibrated one by one; None where fewer than two can be.
    warnings : sessions that determine too little alone, shared parameters that disagree.
    """

    sessions: tuple[JointSession, ...]
    shared: tuple[str, ...]
    names: tuple[str, ...]
    values: Floats
    errors: BlockAndLowRank
    consistency: Consistency | None
    is_converged: bool
    warnings: tuple[str, ...]

    @property
    def covariance(self) -> Floats:
        """The honest covariance of all unknowns, shape (q, q)."""
        return self.errors.dense()

    def with_time_base(self, time_base_utc: np.datetime64 | None) -> JointFit:
        """Return the fit with the instant since which the regressor ``time`` counts its hours."""
        sessions = (
            replace(one, parameters=replace(one.parameters, time_base_utc=time_base_utc)) for one in self.sessions
        )
        return replace(self, sessions=tuple(sessions))

    def to_dict(self) -> dict[str, object]:
        """Return the joint fit as records have it."""
        return {
            "sessions": [session.to_dict() for session in self.sessions],
            "shared": list(self.shared),
            "parameter_names": list(self.names),
            "values": self.values.tolist(),
            "covariance": self.covariance.tolist() if len(self.names) <= MOST_IN_RECORD else None,
            "consistency": None if self.consistency is None else self.consistency.to_dict(),
            "is_converged": self.is_converged,
            "warnings": list(self.warnings),
        }


def joint_fit(
    sessions: Sequence[Observations],
    labels: Sequence[str] | None = None,
    *,
    shared: Sequence[str] = DEFAULT_SHARED,
    is_vector: bool = False,
    robust: str = "none",
    surrounded: Sequence[Surrounded] | None = None,
) -> JointFit:
    """Return the joint calibration of ``sessions``.

    Parameters
    ----------
    sessions : sequence of Observations
        All with the same regressors; rates of a clock are not used.
    labels : sequence of str, optional
        Names of the sessions, ``session 1`` on.
    shared : sequence of str
        Groups (``bias_nt``, ``scale``, ``nonorthogonality_deg``, ``regressors``) or single parameters
        (``bias_nt[1]``) that all sessions have in common.
    is_vector : bool
        Fit the field as a vector; else its magnitude.
    surrounded : sequence of Surrounded, optional
        What each session's errors may be locked to, and what its reference may be off by: the errors contain both.

    Raises
    ------
    OptionError
        No session, unlike regressors, or an unknown parameter in ``shared``.
    NotObservableError
        All sessions together do not determine the parameters.

    Notes
    -----
    Sessions are weighted with their own residuals' variance. Honest errors come from blocks of all sessions.
    """
    if not sessions:
        raise OptionError("a joint fit needs a session")
    named = tuple(labels) if labels is not None else tuple(f"session {i + 1}" for i in range(len(sessions)))
    if len(named) != len(sessions) or len(set(named)) != len(named):
        raise OptionError("labels: want another name for every session")
    alone = [_alone(session, is_vector=is_vector, robust=robust) for session in sessions]
    if robust == AUTO:
        # One loss for all sessions: that of the worst of them.
        robust = "none" if all(fit is None or fit.robust == "none" for fit in alone) else AUTO_LOSS
    problem = _Problem.of(sessions, named, shared, is_vector=is_vector, robust=robust, alone=alone)
    return _assemble(problem, problem.solve(), alone, surrounded)


def _alone(session: Observations, *, is_vector: bool, robust: str) -> Fit | None:
    estimator = VectorFit() if is_vector else ScalarFit()
    try:
        if robust == AUTO:
            return fit_under_loss(estimator, session, FitSettings(robust=robust)).fit
        return estimator.fit(session, FitSettings(robust=robust))
    except EstimationError:
        return None


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The sessions, their place in the unknowns, and where the search begins."""

    sessions: Sequence[Observations]
    labels: tuple[str, ...]
    shared: tuple[str, ...]
    names: tuple[str, ...]
    split: Split
    places: Sequence[NDArray[np.intp]]
    start: Floats
    template: Parameters
    is_vector: bool
    robust: str

    @classmethod
    def of(
        cls,
        sessions: Sequence[Observations],
        labels: tuple[str, ...],
        shared: Sequence[str],
        *,
        is_vector: bool,
        robust: str,
        alone: Sequence[Fit | None],
    ) -> _Problem:
        if len({tuple(session.regressors) for session in sessions}) != 1:
            raise OptionError("the sessions have different regressors")
        first = _first(sessions, alone, is_vector=is_vector, robust=robust)
        template = replace(first, time_offset_s=None)
        common = _shared_names(template, shared)
        is_shared = np.array([name in common for name in template.names])
        split = Split(np.flatnonzero(is_shared), np.flatnonzero(~is_shared))
        kept = tuple(template.names[i] for i in split.shared)
        names, start = list(kept), [template.vector[split.shared]]
        for label, fit in zip(labels, alone, strict=True):
            own = template if fit is None else fit.parameters
            names += [f"{label}:{template.names[i]}" for i in split.own]
            start.append(own.vector[split.own])
        places = split.places(len(labels))
        begin = np.concatenate(start)
        return cls(sessions, labels, kept, tuple(names), split, places, begin, template, is_vector, robust)

    def parameters(self, values: Floats, session: int) -> Parameters:
        return self.template.with_vector(values[self.places[session]])

    def solve(self) -> _Solution:
        """Return the estimate, sessions weighted with their own variance and samples with the robust loss."""
        values, weighted = self.start, list(self.sessions)
        sigmas = np.array([self._sigma(values, i) for i in range(len(self.sessions))])
        for _ in range(_ROUNDS):
            weighted = [self._weighted(values, i, sigma) for i, sigma in enumerate(sigmas)]
            minimum = self._minimise(values, weighted, sigmas)
            moved = np.abs(minimum.theta - values) * np.sqrt(minimum.sums.normal.diagonal())
            values = minimum.theta
            renewed = np.array([self._sigma(values, i) for i in range(len(self.sessions))])
            is_still = bool(np.all(np.abs(renewed - sigmas) <= 1e-4 * sigmas) and np.all(moved <= 1e-3))
            sigmas = renewed
            if is_still:
                break
        return _Solution(values, weighted, sigmas, minimum.is_converged)

    def _residuals_nt(self, values: Floats, session: int) -> Floats:
        return residuals_nt(self.sessions[session], self.parameters(values, session), self.is_vector)

    def _sigma(self, values: Floats, session: int) -> float:
        o, r = self.sessions[session], self._residuals_nt(values, session)
        floor = 1e-9 * float(np.mean(o.b_nt))
        used = o.weights > 0
        if self.robust != "none":
            return robust_sigma(r[used].ravel(), floor)
        count = max(int(np.count_nonzero(used)) * (r.size // len(o)) - len(self.places[session]), 1)
        squares = r**2 if r.ndim == 1 else np.sum(r**2, axis=1)
        return max(float(np.sqrt(np.sum(o.weights * squares) / count)), floor)

    def _weighted(self, values: Floats, session: int, sigma: float) -> Observations:
        o = self.sessions[session]
        if self.robust == "none":
            return o
        r = self._residuals_nt(values, session)
        worst = np.abs(r) if r.ndim == 1 else np.abs(r).max(axis=1)
        return replace(o, weights=o.weights * weights_and_slopes(worst, self.robust, sigma)[0])

    def _minimise(self, values: Floats, weighted: Sequence[Observations], sigmas: Floats) -> BorderedMinimum:
        variances = sigmas**2

        def evaluate(at: Floats) -> Sums:
            parts = [equations_at(o, self.parameters(at, i), is_vector=self.is_vector) for i, o in enumerate(weighted)]
            normals = np.array([part.normal for part in parts]) / variances[:, None, None]
            gradient = np.zeros(len(at))
            for place, part, variance in zip(self.places, parts, variances, strict=True):
                gradient[place] += part.gradient / variance
            cost = float(np.sum(np.array([part.cost for part in parts]) / variances))
            return Sums(Bordered.of(normals, self.split), gradient, cost)

        squares = [np.sum(o.weights * o.b_nt**2) / s**2 for o, s in zip(weighted, sigmas, strict=True)]
        return minimise_bordered(evaluate, values, float(np.sqrt(np.sum(squares))))

    def blocks(self, solution: _Solution) -> JointBlocks:
        """Return the sums over short blocks of equal length, of all sessions one after the other."""
        total = sum(len(session) for session in self.sessions)
        share = _BLOCKS * len(self.sessions) / total
        starts = [block_starts(len(o), max(1, round(share * len(o)))) for o in self.sessions]
        begins, blocks, count = pieces_of(starts)
        sums = [
            block_sums(o, self.parameters(solution.values, i), begins[i], is_vector=self.is_vector)
            for i, o in enumerate(solution.weighted)
        ]
        sessions = np.repeat(np.arange(len(blocks)), [len(one) for one in blocks])
        variances = solution.sigmas[sessions] ** 2
        normals, scores = (np.concatenate([one[which] for one in sums]) for which in (0, 1))
        merged = np.concatenate(blocks)
        return JointBlocks(normals / variances[:, None, None], scores / variances[:, None], sessions, merged, count)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Unknowns, the sessions with their robust weights, and each session's residual deviation, nT."""

    values: Floats
    weighted: Sequence[Observations]
    sigmas: Floats
    is_converged: bool


def _first(
    sessions: Sequence[Observations], alone: Sequence[Fit | None], *, is_vector: bool, robust: str
) -> Parameters:
    """Return parameters to begin with: those of the best session, or of all together where none will do alone."""
    found = [fit for fit in alone if fit is not None]
    if found:
        return min(found, key=lambda fit: float(np.trace(fit.covariance[:3, :3]))).parameters
    pooled = _alone(_pooled(sessions), is_vector=is_vector, robust=robust)
    if pooled is None:
        raise NotObservableError("no session determines the parameters, nor do all of them as one")
    return pooled.parameters


def _pooled(sessions: Sequence[Observations]) -> Observations:
    base = [session.b_base_nt for session in sessions if session.b_base_nt is not None]
    names = list(sessions[0].regressors)
    return Observations(
        np.arange(sum(len(session) for session in sessions), dtype=np.float64),
        np.concatenate([session.h_nt for session in sessions]),
        np.concatenate([session.b_nt for session in sessions]),
        np.concatenate(base) if len(base) == len(sessions) else None,
        np.concatenate([session.weights for session in sessions]),
        {name: np.concatenate([session.regressors[name] for session in sessions]) for name in names},
    )


def _shared_names(template: Parameters, shared: Sequence[str]) -> frozenset[str]:
    """Return the single parameters that ``shared`` names, groups spelled out."""
    groups = {name: name.split("[", maxsplit=1)[0].split(".", maxsplit=1)[0] for name in template.names}
    unknown = [entry for entry in shared if entry not in groups and entry not in groups.values()]
    if unknown:
        known = ", ".join([*dict.fromkeys(groups.values()), *template.names])
        raise OptionError(f"shared: no parameter {unknown[0]!r}; known are {known}", [Fault("shared", "unknown")])
    return frozenset(name for name, group in groups.items() if name in shared or group in shared)


def _assemble(
    problem: _Problem, solution: _Solution, alone: Sequence[Fit | None], surrounded: Sequence[Surrounded] | None
) -> JointFit:
    blocks = problem.blocks(solution)
    formal = _formal(problem, blocks)
    duration_s = sum(covered_s(session.t_s) for session in problem.sessions)
    honest = joint_honest_covariance(blocks, formal, problem.split, duration_s)
    if surrounded is not None:
        hidden = _hidden(problem, solution, formal, surrounded)
        honest = with_hidden(honest, formal, problem.split, hidden)
    errors = np.sqrt(honest.diagonal())
    sessions = tuple(
        JointSession(
            label,
            problem.parameters(solution.values, i),
            problem.parameters(errors, i),
            int(np.count_nonzero(problem.sessions[i].weights > 0)),
            float(solution.sigmas[i]),
        )
        for i, label in enumerate(problem.labels)
    )
    tested = consistency_of_fits(problem.labels, alone, problem.sessions, surrounded)
    warnings = [
        f"not_observable_alone: {label} does not determine the parameters alone"
        for label, fit in zip(problem.labels, alone, strict=True)
        if fit is None
    ]
    if tested is not None:
        warnings += _disagreements(tested, problem.shared)
    names, converged = problem.names, solution.is_converged
    return JointFit(sessions, problem.shared, names, solution.values, honest, tested, converged, tuple(warnings))


def _hidden(
    problem: _Problem, solution: _Solution, formal: BlockAndLowRank, surrounded: Sequence[Surrounded]
) -> list[HiddenErrors]:
    return [
        hidden_errors(
            o,
            problem.parameters(solution.values, i),
            float(solution.sigmas[i]),
            formal.of_group(i, problem.split),
            surrounded[i],
            is_vector=problem.is_vector,
            is_minimum=True,
        )
        for i, o in enumerate(solution.weighted)
    ]


def _formal(problem: _Problem, blocks: JointBlocks) -> BlockAndLowRank:
    """Return the white-noise covariance; what no session determines is refused."""
    normal = Bordered.of(blocks.by_session(blocks.normals), problem.split)
    try:
        return normal.inverse()
    except NotObservableError as error:
        dead = [name for name, square in zip(problem.names, normal.diagonal(), strict=True) if not square > 0]
        hidden = dead or list(problem.names)
        raise NotObservableError("the sessions together do not determine the parameters", hidden) from error


def _disagreements(tested: Consistency, shared: Sequence[str]) -> list[str]:
    count = tested.comparisons
    return [
        f"shared_parameter_differs: {one.parameter} of {one.second} and {one.first} by {one.sigmas:.1f} sigma"
        for one in tested.differences
        if one.parameter in shared and one.p_value * count < INCONSISTENT_P
    ]

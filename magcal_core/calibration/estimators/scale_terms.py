"""A scale that changes with temperature or another column: its slopes estimated beside those of any method.

Notes
-----
The reading h less the terms m x h (axis by axis, x the column) is what the method inside fits. The slopes m take
Gauss-Newton steps beside all its unknowns: linearised at the fit, they are found together, and the fit is made again
with what they take off until they converge. Honest errors: the blocks' scores and normal matrices are widened by the
slopes, with the cross terms, so that every parameter's error knows of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.errors import NotObservableError
from magcal_core.numerics.blocks import BlockScores, block_moments
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations, corrected_nt, residuals_nt
from magcal_core.sensor.correction import readings_without
from magcal_core.sensor.parameterisation import Standardised
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import is_of_scale

_ROUNDS: Final = 30
_STILL: Final = 1e-7
"""Movement of a residual, in units of its noise, that ends the search: that of the methods inside."""
_ROUNDING: Final = 1e-11
"""What is below this share of the field is rounding."""
_DETERMINED: Final = 1e-10
"""Share of a slope's information that the other unknowns must leave."""


@dataclass(frozen=True, slots=True)
class WithScaleTerms:
    """A method that fits regressors of the scale as well; without any it is the method inside."""

    inner: Estimator

    @property
    def name(self) -> str:
        """Name of the method in options and records."""
        return self.inner.name

    @property
    def is_vector(self) -> bool:
        """Whether the method needs the field in the base frame, and its residuals are vectors."""
        return self.inner.is_vector

    @property
    def takes_regressors(self) -> bool:
        """Whether the method can fit regressors and a clock offset."""
        return self.inner.takes_regressors

    @property
    def has_moments(self) -> bool:
        """Whether its fit is the minimum of squares that refits from stored moments start at."""
        return self.inner.has_moments

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate.

        Raises
        ------
        NotObservableError
            The samples do not determine the parameters, or not the slopes of the scale.
        """
        names = _of_scale(observations)
        if not names:
            return self.inner.fit(observations, settings)
        slopes = _begun(names, settings.near)
        near = settings.near
        for _ in range(_ROUNDS):
            plain, _ = without_scale_terms(observations, _known(slopes))
            near = self.inner.fit(plain, replace(settings, near=near))
            linear = _Linear.of(plain, near.parameters, near.weights, _columns(observations, names), self.is_vector)
            slopes, is_still = linear.stepped(slopes, near.residuals_nt, near.sigma_nt)
            if is_still:
                return _widened(near, linear, slopes)
        raise _unsettled(names)

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate from a part of the data of ``near``, or a resample of it: same loss, same noise.

        Raises
        ------
        EstimationError
            The search does not end, or the part does not determine the slopes.
        """
        names = _of_scale(observations)
        if not names:
            return self.inner.refit(observations, settings, near)
        slopes = _begun(names, near)
        weights = observations.weights if len(near.weights) != len(observations) else near.weights
        weights = np.where(observations.weights > 0, weights, 0.0)
        for _ in range(_ROUNDS):
            plain, _ = without_scale_terms(observations, _known(slopes))
            found = self.inner.refit(plain, settings, near)
            linear = _Linear.of(plain, found, weights, _columns(observations, names), self.is_vector)
            slopes, is_still = linear.stepped(slopes, residuals_nt(plain, found, self.is_vector), near.sigma_nt)
            if is_still:
                return replace(found, regressors={**found.regressors, **slopes})
        raise _unsettled(names)


def _unsettled(names: Sequence[str]) -> NotObservableError:
    return NotObservableError("the slopes of the scale do not settle", [f"regressors.{name}" for name in names])


def _of_scale(observations: Observations) -> list[str]:
    return [name for name in observations.regressors if is_of_scale(name)]


def _columns(observations: Observations, names: Sequence[str]) -> list[Floats]:
    return [observations.regressors[name] for name in names]


def _begun(names: Sequence[str], near: Fit | None) -> dict[str, Floats]:
    known: Mapping[str, Floats] = {} if near is None else near.parameters.regressors
    return {name: np.asarray(known.get(name, np.zeros(3))) for name in names}


def without_scale_terms(observations: Observations, parameters: Parameters) -> tuple[Observations, Parameters]:
    """Return both with what ``parameters`` say of the scale's changes taken off the readings, and known no more."""
    terms = {name: slope for name, slope in parameters.regressors.items() if is_of_scale(name)}
    if not terms:
        return observations, parameters
    h_nt = readings_without(observations.regressors, observations.h_nt, replace(parameters, regressors=terms))
    others = [name for name in observations.regressors if not is_of_scale(name)]
    drifts = {name: slope for name, slope in parameters.regressors.items() if name not in terms}
    bare = replace(observations.with_regressors(others), h_nt=np.require(h_nt, np.float64, ["C", "W"]))
    return bare, replace(parameters, regressors=drifts)


def _known(slopes: Mapping[str, Floats]) -> Parameters:
    """Return parameters of which nothing matters but the ``slopes``."""
    return Parameters(np.zeros(3), np.ones(3), np.zeros(3), None, slopes)


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    """One residual of every sample, linearised: |B|, or one axis of the sensor.

    Attributes
    ----------
    columns : shape (n, c)
        Derivatives by those of the method's own unknowns that reach it, which are ``places``, up to their sign.
    slopes : shape (n, s)
        Derivatives by the slopes, which are ``own`` among all of them.
    to_residual : shape (3,), optional
        What turns the residual in the base frame into this one; None where it is one already.
    """

    columns: Floats
    places: NDArray[np.intp]
    slopes: Floats
    own: NDArray[np.intp]
    to_residual: Floats | None

    def residual(self, residuals: Floats) -> Floats:
        """Return this residual, shape (n,), from those of the fit."""
        return residuals if self.to_residual is None else residuals @ self.to_residual


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """The residuals about a fit; ``sign``: -1 where the derivatives are the model's, not the residual's.

    ``count``: number of slopes, three a regressor. ``field_nt``: mean |B|, nT.
    """

    channels: tuple[_Channel, ...]
    weights: Floats
    sign: float
    count: int
    field_nt: float

    @classmethod
    def of(
        cls, o: Observations, parameters: Parameters, weights: Floats, terms: Sequence[Floats], is_vector: bool
    ) -> _Linear:
        z = Standardised.of(tuple(o.regressors), list(o.regressors.values()), len(o))
        made = _of_vector if is_vector else _of_scalar
        return cls(
            tuple(made(o, parameters, z, terms)),
            weights,
            -1.0 if is_vector else 1.0,
            3 * len(terms),
            float(o.b_nt.mean()),
        )

    def stepped(
        self, slopes: Mapping[str, Floats], residuals: Floats, sigma_nt: float
    ) -> tuple[dict[str, Floats], bool]:
        """Return the slopes one step on, and whether residuals of the noise ``sigma_nt`` hardly moved by it."""
        steps = self.steps(residuals)
        moved = {name: slope + step for (name, slope), step in zip(slopes.items(), steps, strict=True)}
        return moved, self.moved(steps) <= _STILL * sigma_nt + _ROUNDING * self.field_nt

    def steps(self, residuals: Floats) -> Floats:
        """Return the step of every slope, shape (s, 3), that the method's own unknowns follow at once."""
        normal, right = np.zeros((self.count, self.count)), np.zeros(self.count)
        for one in self.channels:
            weighed = self.weights[:, None] * one.columns
            across = weighed.T @ one.slopes
            r = one.residual(residuals)
            solved = scaled_inverse(weighed.T @ one.columns) @ np.column_stack([across, weighed.T @ r])
            own = np.ix_(one.own, one.own)
            information = one.slopes.T @ (self.weights[:, None] * one.slopes)
            left = information - across.T @ solved[:, :-1]
            size = np.sqrt(np.diag(information))
            if np.linalg.eigvalsh(left / np.outer(size, size))[0] < _DETERMINED:
                raise NotObservableError("the slopes of the scale cannot be told from the other parameters", ["scale"])
            normal[own] += left
            right[one.own] += one.slopes.T @ (self.weights * r) - across.T @ solved[:, -1]
        return np.asarray(-self.sign * np.linalg.solve(normal, right)).reshape(-1, 3)

    def moved(self, steps: Floats) -> float:
        """Return by how much, nT, root mean square, ``steps`` move the residuals."""
        flat = steps.ravel()
        squares = sum(float(self.weights @ (one.slopes @ flat[one.own]) ** 2) for one in self.channels)
        return float(np.sqrt(squares / self.weights.sum()))


def _of_scalar(o: Observations, at: Parameters, z: Standardised, terms: Sequence[Floats]) -> list[_Channel]:
    """Return |T^-1 (h - b)| - |B| by (L, c, d, clock) and by the slopes."""
    lower = at.correction_matrix
    x_nt = corrected_nt(o, at)
    u = x_nt / np.linalg.norm(x_nt, axis=1)[:, None]
    rows, entries = np.tril_indices(3)
    drifts = [-u * column[:, None] for column in z.columns.T]
    columns = np.column_stack([u[:, rows] * o.h_nt[:, entries], -u, *drifts, o.rate_nt_s])
    slopes = np.column_stack([-(u @ lower) * term for term in terms])
    return [_Channel(columns, np.arange(columns.shape[1]), slopes, np.arange(slopes.shape[1]), None)]


def _of_vector(o: Observations, at: Parameters, z: Standardised, terms: Sequence[Floats]) -> list[_Channel]:
    """Return the model of each axis, T B + b + slopes z, by its own unknowns and by the slopes of the scale."""
    matrix, b_nt = at.matrix, o.require_vector()
    k, found = len(z.names), []
    rates = np.zeros((len(o), 0, 3)) if o.rate_base_nt_s is None else o.rate_base_nt_s
    first = 9 + 3 * k
    for axis in range(3):
        columns = np.column_stack([b_nt[:, : axis + 1], np.ones(len(o)), z.columns, -rates @ matrix[axis]])
        begin = (0, 1, 3)[axis]
        places = [*range(begin, begin + axis + 1), 6 + axis, *(9 + 3 * j + axis for j in range(k))]
        places += range(first, first + rates.shape[1])
        slopes = np.column_stack([term[:, axis] for term in terms])
        own = np.arange(axis, 3 * len(terms), 3)
        # The fit's residual is corrected - model in the base frame; along the axis it is h - b - T B.
        found.append(_Channel(columns, np.array(places), slopes, own, matrix[axis]))
    return found


def _widened(fit: Fit, linear: _Linear, slopes: Mapping[str, Floats]) -> Fit:
    """Return ``fit`` with the ``slopes`` among its parameters, its covariance and its blocks."""
    blocks, m, s = fit.blocks, fit.clock.size, linear.count
    q = blocks.scores.shape[1]
    at = np.concatenate([np.arange(q - m), np.arange(q - m + s, q + s)])
    new = np.arange(q - m, q - m + s)
    scores, normals = np.zeros((len(blocks.starts), q + s)), np.zeros((len(blocks.starts), q + s, q + s))
    scores[:, at] = blocks.scores
    normals[:, at[:, None], at] = blocks.normals
    for one in linear.channels:
        r = one.residual(fit.residuals_nt)
        weighed = linear.weights[:, None] * one.slopes
        share, softness = _shares(fit, one, linear, r)
        across = share * softness * block_moments(one.columns, weighed, blocks.starts)
        places, own = at[one.places], new[one.own]
        normals[:, places[:, None], own] += across
        normals[:, own[:, None], places] += across.swapaxes(1, 2)
        normals[:, own[:, None], own] += share * softness * block_moments(one.slopes, weighed, blocks.starts)
        scores[:, own] += share * block_moments(weighed, r[:, None], blocks.starts)[:, :, 0]
    to_parameters = np.zeros((q + s, q + s))
    to_parameters[at[:, None], at] = blocks.to_parameters
    to_parameters[new, new] = 1.0
    inverse = blocks.to_parameters @ scaled_inverse(blocks.normals.sum(axis=0)) @ blocks.to_parameters.T
    noise = float(np.mean(np.diag(fit.covariance) / np.diag(inverse)))
    covariance = noise * to_parameters @ scaled_inverse(normals.sum(axis=0)) @ to_parameters.T
    regressors = {**fit.parameters.regressors, **slopes}
    return replace(
        fit,
        parameters=replace(fit.parameters, regressors=regressors),
        covariance=covariance,
        blocks=BlockScores(scores, normals, blocks.starts, to_parameters),
    )


def _shares(fit: Fit, one: _Channel, linear: _Linear, r: Floats) -> tuple[float, float]:
    """Return what the fit weighs this residual with among others, and what a loss divides its normal matrix by."""
    share = 1.0
    if one.to_residual is not None:
        count = int(np.count_nonzero(linear.weights > 0)) - one.columns.shape[1]
        share = max(count, 1) / float(linear.weights @ r**2)
    first = one.places[-1 - fit.clock.size]
    own = float(linear.weights @ one.columns[:, -1 - fit.clock.size] ** 2)
    return share, float(fit.blocks.normals[:, first, first].sum()) / (share * own)

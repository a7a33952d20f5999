"""What goes into an estimator and what comes out: observations, settings, fit."""

from __future__ import annotations

import enum
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.corrections import correct, corrected_lengths, lengths
from magcal_core.calibration.result import Candidate, Parameters
from magcal_core.errors import OptionError, OrbitMissingError, TelemetryValueError, TooFewSamplesError, UnitsError
from magcal_core.regressor_columns import (
    RESPONSES,
    TIME_REGRESSOR,
    is_of_scale,
    is_response,
    regressor_of,
    source_of,
    term_nt,
)
from magcal_core.samples import Samples, selects_all
from magcal_core.sensor import inverse_lower, matrix_of_parameters
from magcal_core.units import NT_PER_UNIT

if TYPE_CHECKING:
    from magcal_core.calibration.estimators.robust_start import RobustStart

Floats = NDArray[np.float64]

UNIT_RATIO: Final = (0.1, 10.0)
"""Where median |h| / |B| may lie: outside, the unit is wrong."""


class FitStatus(enum.StrEnum):
    """How the search for the estimate ended."""

    CONVERGED = "converged"
    MAX_EVALUATIONS = "max_evaluations"


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The usable samples as an estimator sees them, in time order.

    Attributes
    ----------
    t_s : shape (n,)
        Seconds since the first sample.
    h_nt : shape (n, 3)
        Raw reading, nT.
    b_nt : shape (n,)
        Magnitude of the true field, nT.
    b_base_nt : shape (n, 3), optional
        True field in the magnetometer's base frame, nT.
    weights : shape (n,)
        Prior weight of each sample; zero equals absent.
    regressors : name -> shape (n,), or (n, 3)
        Columns that may move the bias, and columns times the reading, which move the scale.
    rate_nt_s : shape (n, m)
        Fall of `b_nt` by each unknown of the clock (offset, s; drift, s/s): m = 0 where none is estimated.
    rate_base_nt_s : shape (n, m, 3), optional
        The same of `b_base_nt`.
    """

    t_s: Floats
    h_nt: Floats
    b_nt: Floats
    b_base_nt: Floats | None
    weights: Floats
    regressors: Mapping[str, Floats] = field(default_factory=dict)
    rate_nt_s: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    rate_base_nt_s: Floats | None = None

    def __post_init__(self) -> None:
        if self.rate_nt_s.size == 0:
            object.__setattr__(self, "rate_nt_s", np.zeros((len(self.t_s), 0)))

    def __len__(self) -> int:
        return len(self.t_s)

    @classmethod
    def of(cls, samples: Samples, regressors: Sequence[str] = (), weights: Floats | None = None) -> Observations:
        """Return the observations in ``samples`` whose flags let them be used.

        Raises
        ------
        OrbitMissingError
            The samples have no reference field.
        TelemetryValueError
            A value that is to be used is not finite, or no sample is usable.
        UnitsError
            The readings are out of all proportion to the field.
        OptionError
            A regressor is no column of the samples, or is constant.
        """
        prior = np.ones(len(samples)) if weights is None else np.asarray(weights, dtype=np.float64)
        is_used = samples.is_used & (prior > 0)
        if not is_used.any():
            raise TooFewSamplesError("no usable sample")
        used = samples.take(is_used)
        b_base = used.b_ref_base_nt
        magnitude = used.b_ref_magnitude_nt
        if magnitude is None:
            vector = b_base if b_base is not None else used.b_ref_gcrf_nt
            if vector is None:
                raise OrbitMissingError("the samples have no reference field")
            magnitude = np.linalg.norm(vector, axis=1)
        t_s = (used.t_utc - used.t_utc[0]) / np.timedelta64(1, "ns") * 1e-9
        columns = {name: _regressor(samples, is_used, name) for name in regressors}
        made = cls(
            t_s, _own(used.h_nt), _own(magnitude), None if b_base is None else _own(b_base), prior[is_used], columns
        )
        made._check()
        return made

    def _check(self) -> None:
        columns = [("h_nt", self.h_nt), ("reference", self.b_nt), ("weights", self.weights), *self.regressors.items()]
        if self.b_base_nt is not None:
            columns.append(("reference", self.b_base_nt))
        for name, column in columns:
            bad = ~np.isfinite(column)
            if bad.any():
                raise TelemetryValueError(f"{name}: {np.count_nonzero(bad)} values are not finite")
        if np.any(self.b_nt <= 0):
            raise TelemetryValueError("reference: a field magnitude is not positive")
        check_units(self.h_nt, self.b_nt)

    def take(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Observations:
        """Return the observations that ``index`` selects; a mask that keeps all copies nothing."""
        if selects_all(index):
            return self
        return Observations(
            self.t_s[index],
            _own(self.h_nt[index]),
            _own(self.b_nt[index]),
            None if self.b_base_nt is None else _own(self.b_base_nt[index]),
            self.weights[index],
            {name: column[index] for name, column in self.regressors.items()},
            _own(self.rate_nt_s[index]),
            None if self.rate_base_nt_s is None else _own(self.rate_base_nt_s[index]),
        )

    def with_regressors(self, names: Sequence[str]) -> Observations:
        """Return the observations with only the regressors ``names``, in that order."""
        return replace(self, regressors={name: self.regressors[name] for name in names})

    def require_vector(self) -> Floats:
        """Return the true field in the base frame, shape (n, 3), nT.

        Raises
        ------
        TelemetryValueError
            The samples have none: attitude is unknown.
        """
        if self.b_base_nt is None:
            raise TelemetryValueError(
                "the vector methods need the attitude (qw..qz) or the field in the base frame (ref_bx, ref_by, ref_bz)"
            )
        return self.b_base_nt


def _own(array: Floats) -> Floats:
    """Return ``array`` as the compiled kernels want it: contiguous, writable, float64; one compiled form serves all."""
    return np.require(array, np.float64, ["C", "W"])


def _regressor(samples: Samples, is_used: NDArray[np.bool_], name: str) -> Floats:
    """Return a regressor at the samples that are used; a lag reaches over samples that are not."""
    source = source_of(name)
    t_s = (samples.t_utc - samples.t_utc[is_used][0]) / np.timedelta64(1, "ns") * 1e-9
    columns = {TIME_REGRESSOR: t_s / 3600.0, **samples.housekeeping}
    if is_response(name):
        return regressor_of(name, columns, samples.h_nt[is_used], t_s[is_used])
    if source not in columns:
        known = ", ".join([TIME_REGRESSOR, *samples.housekeeping, *RESPONSES])
        raise OptionError(f"no housekeeping column {source!r}; there are {known}")
    column = np.asarray(columns[source], dtype=np.float64)[is_used]
    if source in samples.housekeeping and np.isfinite(column).all() and np.ptp(column) == 0.0:
        moved = "scale" if is_of_scale(name) else "bias"
        raise OptionError(f"regressor {name!r} is constant: it cannot be told from the {moved}")
    return _own(regressor_of(name, columns, samples.h_nt, t_s)[is_used])


def check_units(h_nt: Floats, b_nt: Floats) -> None:
    """Refuse readings ``h_nt``, shape (n, 3), that no unit error short of a wrong one explains beside ``b_nt``.

    Raises
    ------
    UnitsError
        Median |h| / |B| is outside `UNIT_RATIO`; the message names the unit that would fit.
    """
    ratio = float(np.median(lengths(h_nt) / b_nt))
    if UNIT_RATIO[0] <= ratio <= UNIT_RATIO[1]:
        return
    fits = [unit for unit, factor in NT_PER_UNIT.items() if unit != "nT" and 0.3 <= ratio * factor <= 3.0]
    named = f"; a unit of {' or '.join(fits)} would fit" if fits else ""
    raise UnitsError(
        f"readings are {ratio:.3g} times the field, outside {UNIT_RATIO[0]}..{UNIT_RATIO[1]}: the unit is wrong{named}"
    )


@dataclass(frozen=True, slots=True, eq=False)
class FitSettings:
    """How to fit: robust loss, noise model, noise of a component (nT, where known), start (for studies).

    ``near``: a fit under the same settings to nearly the same data, where the search begins and whose scale it takes.
    ``begin``: where a loss begins that the plain fit is no start for. ``is_gated``: whether samples that do not
    determine the parameters are refused; else that is for the caller to ask, once bad rows have lost their weight.
    """

    robust: str = "none"
    noise_model: str = "none"
    noise_nt: float | None = None
    start: Parameters | None = None
    near: Fit | None = None
    begin: RobustStart | None = None
    is_gated: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class BlockScores:
    """The estimating equations summed over short consecutive blocks: what honest errors are computed from.

    Attributes
    ----------
    scores : shape (m, q)
        Sum of J^T W r over each block, in the estimator's own unknowns.
    normals : shape (m, q, q)
        Sum of J^T W J over each block.
    starts : shape (m,)
        First sample of each block.
    to_parameters : shape (p, q)
        Derivative of the reported parameters by the estimator's own unknowns.
    """

    scores: Floats
    normals: Floats
    starts: NDArray[np.intp]
    to_parameters: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One estimate.

    Attributes
    ----------
    parameters : Parameters
    covariance : shape (p, p)
        Formal covariance (white noise), in the order of `Parameters.names`.
    residuals_nt : shape (n,) or (n, 3)
        |corrected| - |model|, or corrected - model in the base frame.
    weights : shape (n,)
        Prior weight times robust weight.
    sigma_nt : float
        Standard deviation that the formal covariance is based on, nT.
    robust, robust_scale_nt : str, float
        The loss, and the robust standard deviation that it was scaled with, nT; 1 where there was none.
    noise_nt : float
        Noise of a component, nT, whose bias was removed; negative where none was.
    clock : shape (m,)
        Unknowns of the clock on top of the reference's: offset, s, and drift, s/s; the last rows of the covariance.
    cost : float
        Sum of squares (of robust losses) at the estimate, nT^2.
    """

    method: str
    parameters: Parameters
    covariance: Floats
    residuals_nt: Floats
    weights: Floats
    sigma_nt: float
    cost: float
    status: FitStatus
    evaluations: int
    blocks: BlockScores
    robust: str = "none"
    robust_scale_nt: float = 1.0
    noise_nt: float = -1.0
    clock: Floats = field(default_factory=lambda: np.zeros(0))
    candidates: tuple[Candidate, ...] = ()
    warnings: tuple[str, ...] = ()
    extras: Mapping[str, object] = field(default_factory=dict)

    @property
    def formal_standard_errors(self) -> Parameters:
        """Square roots of the diagonal of the formal covariance, in the shape of the parameters."""
        return self.parameters.with_vector(np.sqrt(np.diag(self.covariance))[: len(self.parameters.names)])


class Estimator(Protocol):
    """One calibration method."""

    @property
    def name(self) -> str:
        """Name of the method in options and records."""
        ...

    @property
    def is_vector(self) -> bool:
        """Whether the method needs the field in the base frame, and its residuals are vectors."""
        ...

    @property
    def takes_regressors(self) -> bool:
        """Whether the method can fit regressors and a clock offset."""
        ...

    def fit(self, observations: Observations, settings: FitSettings) -> Fit:
        """Return the estimate.

        Raises
        ------
        NotObservableError
            The samples do not determine the parameters.
        """
        ...

    def refit(self, observations: Observations, settings: FitSettings, near: Fit) -> Parameters:
        """Return the estimate from a part of the data of ``near``, or a resample of it: same loss, same noise.

        Starts at ``near`` and checks nothing beforehand: what cross-validation and bootstrap call often.

        Raises
        ------
        EstimationError
            The search does not end.
        """
        ...


def corrected_nt(observations: Observations, parameters: Parameters) -> Floats:
    """Return T^-1 (h - b - sum of regressor terms), shape (n, 3), nT, base frame."""
    return FittedReadings(observations.h_nt, observations.regressors, parameters).corrected_base_nt


@dataclass(frozen=True, slots=True, eq=False)
class FittedReadings:
    """Raw readings, shape (n, 3), nT, and regressors, with what ``parameters`` make of them when it is asked for."""

    h_nt: Floats
    regressors: Mapping[str, Floats]
    parameters: Parameters

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        return lengths(self.h_nt)

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        reading = readings_without(self.regressors, self.h_nt, self.parameters)
        return corrected_lengths(reading, self.parameters.bias_nt, _lower(self.parameters))

    @property
    def corrected_base_nt(self) -> Floats:
        """Corrected reading T^-1 (h - b - sum of regressor terms), shape (n, 3), base frame, nT."""
        reading = readings_without(self.regressors, self.h_nt, self.parameters)
        return correct(reading, self.parameters.bias_nt, _lower(self.parameters))


def _lower(parameters: Parameters) -> Floats:
    return inverse_lower(matrix_of_parameters(parameters.scale, np.deg2rad(parameters.nonorthogonality_deg)))


def readings_without(regressors: Mapping[str, Floats], h_nt: Floats, parameters: Parameters) -> Floats:
    """Return ``h_nt``, shape (n, 3), nT, less what ``parameters`` say that the ``regressors`` add; itself for none."""
    for name, coefficients in parameters.regressors.items():
        h_nt = h_nt - term_nt(regressors[name], coefficients)
    return h_nt


def residuals_nt(observations: Observations, parameters: Parameters, is_vector: bool) -> Floats:
    """Return corrected - model, shape (n, 3), or |corrected| - |model|, shape (n,), nT."""
    readings = FittedReadings(observations.h_nt, observations.regressors, parameters)
    found, model = (
        (readings.corrected_base_nt, observations.require_vector())
        if is_vector
        else (readings.corrected_nt, observations.b_nt)
    )
    found -= model
    return found


def block_starts(n: int, blocks: int = 256) -> NDArray[np.intp]:
    """Return the first samples of consecutive blocks of ``n`` samples, of nearly equal length.

    About eight samples each, at least 16 and at most ``blocks`` blocks.
    """
    count = min(n, blocks, max(16, n // 8))
    return (np.arange(count, dtype=np.intp) * n) // count


def block_moments(left: Floats, right: Floats, starts: NDArray[np.intp]) -> Floats:
    """Return left^T right summed over each block, shape (m, c, d), from columns of shape (n, c) and (n, d)."""
    edges = [*starts, len(left)]
    return np.stack([left[i:j].T @ right[i:j] for i, j in itertools.pairwise(edges)])


def scaled_inverse(normal: Floats) -> Floats:
    """Return the inverse of a normal matrix, taken with a unit diagonal so that units cost no digits."""
    size = np.sqrt(np.diag(normal))
    return np.asarray(np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size))

"""What goes into an estimator and what comes out: observations, settings, fit."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.parts import FirstOrder, FullMatrix
from magcal_core.numerics.blocks import BlockScores
from magcal_core.observations import Observations
from magcal_core.sensor.parameters import Parameters

if TYPE_CHECKING:
    from magcal_core.calibration.estimators.robust_start import RobustStart


class FitStatus(enum.StrEnum):
    """How the search for the estimate ended."""

    CONVERGED = "converged"
    MAX_EVALUATIONS = "max_evaluations"


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
    full_matrix, first_order : what the vector methods, and the search of the DEKART paper, find beside.
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
    full_matrix: FullMatrix | None = None
    first_order: FirstOrder | None = None

    @property
    def extras(self) -> dict[str, object]:
        """What only some methods find, under the names that the record gives it."""
        parts = {"full_matrix": self.full_matrix, "first_order": self.first_order}
        return {name: part.to_dict() for name, part in parts.items() if part is not None}

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

    @property
    def has_moments(self) -> bool:
        """Whether its fit is the minimum of squares that refits from stored moments start at."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One candidate solution of the closed form; ``undefined`` says why there is none at this root."""

    roots: tuple[int, int]
    parameters: Parameters | None
    cost: float | None
    stationarity: float | None
    is_stationary: bool
    is_selected: bool
    undefined: str | None = None
    spread: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, object]:
        """Return the candidate as the records of the service have it."""
        return {
            "roots": list(self.roots),
            "parameters": None if self.parameters is None else self.parameters.to_dict(),
            "cost": self.cost,
            "stationarity": self.stationarity,
            "is_stationary": self.is_stationary,
            "selected": self.is_selected,
            "undefined": self.undefined,
            "spread": dict(self.spread),
        }

"""What a calibration says: the parameters, how far they can be trusted, and where they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from magcal_core.calibration.moments import FitMoments

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Parameters of the sensor model h = T B + b, or their standard errors: the same shape serves both.

    Attributes
    ----------
    bias_nt : shape (3,)
        Zero offset b, nT.
    scale : shape (3,)
        Scale factors k.
    nonorthogonality_deg : shape (3,)
        Angles e1, e2, e3 of the sensing axes, deg.
    time_offset_s : float or None
        Seconds to add to the telemetry's clock to have the orbit's time; None where it was not estimated.
    regressors : name -> shape (3,)
        Change of the bias per unit of each regressor, nT per unit.
    """

    bias_nt: Floats
    scale: Floats
    nonorthogonality_deg: Floats
    time_offset_s: float | None = None
    regressors: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the covariance."""
        base = [f"{group}[{i}]" for group in ("bias_nt", "scale", "nonorthogonality_deg") for i in range(3)]
        extra = [f"regressors.{name}[{i}]" for name in self.regressors for i in range(3)]
        clock = [] if self.time_offset_s is None else ["time_offset_s"]
        return (*base, *extra, *clock)

    @property
    def vector(self) -> Floats:
        """The parameters in one array, in the order of `names`."""
        extra = [self.regressors[name] for name in self.regressors]
        clock = [] if self.time_offset_s is None else [np.array([self.time_offset_s])]
        return np.concatenate([self.bias_nt, self.scale, self.nonorthogonality_deg, *extra, *clock])

    def with_vector(self, values: Floats) -> Parameters:
        """Return parameters of the same shape with other ``values``, in the order of `names`."""
        names = list(self.regressors)
        regressors = {name: values[9 + 3 * i : 12 + 3 * i] for i, name in enumerate(names)}
        clock = None if self.time_offset_s is None else float(values[-1])
        return Parameters(values[0:3], values[3:6], values[6:9], clock, regressors)

    def to_dict(self) -> dict[str, object]:
        """Return the parameters as the records of the service have them."""
        return {
            "bias_nt": self.bias_nt.tolist(),
            "scale": self.scale.tolist(),
            "nonorthogonality_deg": self.nonorthogonality_deg.tolist(),
            "time_offset_s": self.time_offset_s,
            "regressors": {name: value.tolist() for name, value in self.regressors.items()},
        }


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Statistics of a residual, nT; ``max_percent`` is the largest |residual| / |model|, in per cent."""

    mean_nt: float
    std_nt: float
    rms_nt: float
    max_abs_nt: float
    max_percent: float

    def to_dict(self) -> dict[str, float]:
        """Return the statistics as the records of the service have them."""
        return {name: getattr(self, name) for name in self.__slots__}


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


@dataclass(frozen=True, slots=True)
class Reason:
    """One machine-readable reason of a verdict."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What magcal says of a parameter set in one word, ``accept``, ``weak`` or ``refuse``, with the reasons."""

    grade: str
    reasons: tuple[Reason, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the verdict as the records of the service have it."""
        return {"grade": self.grade, "reasons": [f"{reason.code}: {reason.text}" for reason in self.reasons]}


@dataclass(frozen=True, slots=True)
class Observability:
    """How well the samples determine the parameters (`docs/references.md`: magcal-observability)."""

    index: float
    condition_number: float
    sphere_coverage: float
    weak_directions: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the figures as the records of the service have them."""
        return {
            "index": self.index,
            "condition_number": self.condition_number,
            "sphere_coverage": self.sphere_coverage,
            "weak_directions": list(self.weak_directions),
        }


class Readings(Protocol):
    """Raw and corrected readings of every sample of a residual table: kept, or computed whenever they are asked for."""

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        ...

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        ...

    @property
    def corrected_base_nt(self) -> Floats | None:
        """Corrected reading T^-1 (h - b), shape (n, 3), base frame, nT; None where only magnitudes are known."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class StoredReadings:
    """`Readings` that were read from a file."""

    raw_nt: Floats
    corrected_nt: Floats
    corrected_base_nt: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTable:
    """Residual of every sample of a calibration, the left-out ones included, in time order.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (n,)
    model_nt : shape (n,)
        Magnitude of the reference field, nT; NaN where there is none.
    residual_nt : shape (n,) or (n, 3)
        |corrected| - |model| for scalar methods, corrected - model in the base frame for vector methods.
    weight : shape (n,)
        Weight of the sample in the fit, 0 where it was left out.
    flags : shape (n,)
        `SampleFlag` bits.
    readings : Readings
        Raw and corrected readings: where on the body sphere a residual arose.
    r_itrf_km : shape (n, 3), optional
        Position, ITRF, km: where over the Earth a residual arose.
    """

    t_utc: NDArray[np.datetime64]
    model_nt: Floats
    residual_nt: Floats
    weight: Floats
    flags: NDArray[np.uint16]
    readings: Readings
    r_itrf_km: Floats | None = None

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        return self.readings.raw_nt

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        return self.readings.corrected_nt

    @property
    def corrected_base_nt(self) -> Floats | None:
        """Corrected reading, shape (n, 3), base frame, nT; None where only magnitudes are known."""
        return self.readings.corrected_base_nt


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of one calibration; `to_dict` gives the parameter set of the service's records.

    ``moments``: what the fit can be made again from, where they were asked for and the method has them.

    ``extras`` holds results that only some calibrations have (``first_order``, ``ablation``, ...), under the names
    that the record gives them.
    """

    method: str
    field_model: str
    orbit_model: str
    data_from: np.datetime64
    data_until: np.datetime64
    parameters: Parameters
    covariance: Floats
    standard_errors: Parameters
    formal_standard_errors: Parameters
    matrix: Floats
    correction_matrix: Floats
    candidates: tuple[Candidate, ...]
    samples: int
    rejected: int
    cross_validated_rms_nt: float | None
    before: ResidualStatistics
    after: ResidualStatistics
    observability: Observability
    verdict: Verdict
    warnings: tuple[str, ...]
    residuals: ResidualTable
    options: Mapping[str, object]
    orbits: Sequence[Mapping[str, object]] = ()
    sources: Mapping[str, object] = field(default_factory=dict)
    extras: Mapping[str, object] = field(default_factory=dict)
    moments: FitMoments | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the parameter set as `service` records have it, without the ids that only the service knows."""
        return {
            "status": "candidate",
            "verdict": self.verdict.to_dict(),
            "data_from": utc_text(self.data_from),
            "data_until": utc_text(self.data_until),
            "method": self.method,
            "field_model": self.field_model,
            "orbit_model": self.orbit_model,
            "parameters": self.parameters.to_dict(),
            "standard_errors": self.standard_errors.to_dict(),
            "parameter_names": list(self.parameters.names),
            "covariance": self.covariance.tolist(),
            "formal_standard_errors": self.formal_standard_errors.to_dict(),
            "matrix": self.matrix.tolist(),
            "correction_matrix": self.correction_matrix.tolist(),
            "candidates": [candidate.to_dict() for candidate in self.candidates],
            "statistics": {
                "samples": self.samples,
                "rejected": self.rejected,
                "cross_validated_rms_nt": self.cross_validated_rms_nt,
                "before": self.before.to_dict(),
                "after": self.after.to_dict(),
            },
            "observability": self.observability.to_dict(),
            "warnings": list(self.warnings),
            **self.extras,
            "provenance": {
                "orbits": [dict(orbit) for orbit in self.orbits],
                "options": dict(self.options),
                **self.sources,
            },
        }


def utc_text(t_utc: np.datetime64) -> str:
    """Return ``t_utc`` in ISO 8601 with ``Z`` and microseconds."""
    return f"{np.datetime_as_string(t_utc, unit='us')}Z"

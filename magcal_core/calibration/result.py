"""What a calibration says: the parameters, how far they can be trusted, and where they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Candidate
from magcal_core.calibration.observability.information import Observability
from magcal_core.calibration.reasons import Verdict
from magcal_core.calibration.residuals import ResidualStatistics, ResidualTable
from magcal_core.sensor.parameters import Parameters

if TYPE_CHECKING:
    from magcal_core.calibration.refit.moments import FitMoments


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
            "provenance": {"orbits": [dict(orbit) for orbit in self.orbits], "options": dict(self.options)},
        }


def utc_text(t_utc: np.datetime64) -> str:
    """Return ``t_utc`` in ISO 8601 with ``Z`` and microseconds."""
    return f"{np.datetime_as_string(t_utc, unit='us')}Z"

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
from magcal_core.units import utc_text

if TYPE_CHECKING:
    from magcal_core.calibration.refit.moments import FitMoments
    from magcal_core.calibration.sessions.windows import Windows
    from magcal_core.calibration.terms.bias_steps import BiasSteps


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Result of one calibration; `to_dict` gives the parameter set of the service's records.

    ``moments``: what the fit can be made again from, where they were asked for and the method has them.
    ``bias_steps``, ``windows``: what was found of a bias that moves inside the session, where it was looked for.

    ``extras`` holds what is for the record alone, as JSON under the names that the record gives it (``first_order``,
    ``ablation``, ...); nothing is computed from it.
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
    bias_steps: BiasSteps | None = None
    windows: Windows | None = None

    @property
    def has_full_matrix(self) -> bool:
        """Whether T has elements above its diagonal: the fit has twelve parameters, not nine."""
        return bool(np.triu(self.matrix, 1).any())

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
            **({} if self.bias_steps is None else {"bias_steps": self.bias_steps.to_dict()}),
            **({} if self.windows is None else {"windows": self.windows.to_dict()}),
            "provenance": {
                "orbits": [dict(orbit) for orbit in self.orbits],
                "options": dict(self.options),
                **self.sources,
            },
        }

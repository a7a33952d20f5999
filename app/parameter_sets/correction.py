"""A parameter set at work: raw samples to corrected ones, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, TelemetryFormatError
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import is_of_scale, missing_columns, source_of, with_steps, with_time


@dataclass(frozen=True, slots=True)
class Correction:
    """The sensor of a parameter set and how its bias, nT per unit, and its scale, per unit, follow the regressors."""

    sensor: SensorModel
    regressors: Mapping[str, Floats]
    time_base_utc: np.datetime64 | None = None

    @classmethod
    def of(cls, record: Mapping[str, object]) -> Correction:
        """Return the correction that a parameter set's record describes."""
        found = Parameters.from_record(record)
        return cls(
            SensorModel(found.bias_nt, found.scale, found.nonorthogonality_deg), found.regressors, found.time_base_utc
        )

    def apply(self, samples: Samples) -> Samples:
        """Return ``samples`` with corrected readings in the base frame, nT."""
        drift_nt, share = self._terms(samples)
        return replace(samples, h_nt=self.sensor.correct(samples.h_nt * (1.0 - share) - drift_nt))

    def unapply(self, samples: Samples) -> Samples:
        """Return ``samples``, whose readings are corrected, with raw readings, nT."""
        drift_nt, share = self._terms(samples)
        return replace(samples, h_nt=(self.sensor.apply(samples.h_nt) + drift_nt) / (1.0 - share))

    def _terms(self, samples: Samples) -> tuple[Floats, Floats]:
        """Return what the bias and, as a share of the raw reading, the scale add to each reading, shape (n, 3)."""
        timed = with_time(samples.housekeeping, samples.t_utc, self.time_base_utc)
        keeping = with_steps(self.regressors, timed, samples.t_utc)
        missing = missing_columns(self.regressors, keeping)
        if missing:
            faults = [Fault(f"column {name}", "missing; the parameter set has it as a regressor") for name in missing]
            raise TelemetryFormatError("the telemetry lacks a regressor of the parameter set", faults)
        drift_nt, share = np.zeros_like(samples.h_nt), np.zeros_like(samples.h_nt)
        for name, change in self.regressors.items():
            added = share if is_of_scale(name) else drift_nt
            added += keeping[source_of(name)][:, None] * change
        return drift_nt, share

"""A parameter set at work: raw samples to corrected ones, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, OptionError, TelemetryFormatError
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel, lower_triangular_gauge
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import (
    OF_SCALE,
    is_of_scale,
    is_response,
    lag_of,
    lagged,
    missing_columns,
    regressor_of,
    source_of,
    with_steps,
    with_time,
)


@dataclass(frozen=True, slots=True)
class Correction:
    """The sensor of a parameter set and how its bias, nT per unit, and its scale, per unit, follow the regressors.

    ``rotation``: R of T = T_low R, shape (3, 3), T_low that of ``sensor``: from the base frame to the sensor's own.
    """

    sensor: SensorModel
    regressors: Mapping[str, Floats]
    rotation: Floats
    time_base_utc: np.datetime64 | None = None

    @classmethod
    def of(cls, record: Mapping[str, object]) -> Correction:
        """Return the correction that a parameter set's record describes."""
        found = Parameters.from_record(record)
        return cls(found.sensor, found.regressors, rotation_of(record.get("matrix")), found.time_base_utc)

    def apply(self, samples: Samples) -> Samples:
        """Return ``samples`` with corrected readings in the base frame, nT."""
        drift_nt, share = self._terms(samples)
        along_axes_nt = self.sensor.correct(samples.h_nt * (1.0 - share) - drift_nt)
        return replace(samples, h_nt=along_axes_nt @ self.rotation)

    def unapply(self, samples: Samples) -> Samples:
        """Return ``samples``, whose readings are corrected, with raw readings, nT.

        Raises
        ------
        OptionError
            The parameter set has a response of the reading itself, which cannot be taken back from corrected ones.
        """
        responses = [name for name in self.regressors if is_response(name)]
        if responses:
            raise OptionError(f"the parameter set has the response {responses[0]}, which cannot be taken back")
        drift_nt, share = self._terms(samples)
        return replace(samples, h_nt=(self.sensor.apply(samples.h_nt @ self.rotation.T) + drift_nt) / (1.0 - share))

    def _terms(self, samples: Samples) -> tuple[Floats, Floats]:
        """Return what the bias and, as a share of the raw reading, the scale add to each reading, shape (n, 3)."""
        timed = with_time(samples.housekeeping, samples.t_utc, self.time_base_utc)
        keeping = with_steps(self.regressors, timed, samples.t_utc)
        missing = missing_columns(self.regressors, keeping)
        if missing:
            faults = [Fault(f"column {name}", "missing; the parameter set has it as a regressor") for name in missing]
            raise TelemetryFormatError("the telemetry lacks a regressor of the parameter set", faults)
        drift_nt, share = np.zeros_like(samples.h_nt), np.zeros_like(samples.h_nt)
        t_s = (samples.t_utc - samples.t_utc[:1]) / np.timedelta64(1, "ns") * 1e-9
        for name, change in self.regressors.items():
            if is_response(name):
                drift_nt += regressor_of(name, samples.housekeeping, samples.h_nt, t_s) * change
                continue
            added = share if is_of_scale(name) else drift_nt
            column = np.asarray(keeping[source_of(name)], np.float64)
            added += lagged(column, lag_of(name.removesuffix(OF_SCALE))[1], t_s)[:, None] * change
        return drift_nt, share


def rotation_of(matrix: object) -> Floats:
    """Return R of T = T_low R, shape (3, 3), for the ``matrix`` T of a record; no turn where T is lower triangular."""
    if matrix is None:
        return np.eye(3)
    full = np.asarray(matrix, dtype=np.float64)
    return lower_triangular_gauge(full)[1] if np.triu(full, 1).any() else np.eye(3)

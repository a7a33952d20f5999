"""A session against a parameter set that need not come from it: is what is in force still right?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from app.errors import ConflictError
from app.records.parameter_set import ParameterSetRecord, ParametersRecord
from magcal_core.arrays import Floats
from magcal_core.field.models import field_model
from magcal_core.observations import Observations, residuals_nt
from magcal_core.orbit import Orbit
from magcal_core.reference.columns import with_reference
from magcal_core.samples import Samples
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import TIME_REGRESSOR, source_of

MOST_SAMPLES: Final = 20_000
"""Samples that are looked at; a longer session is thinned evenly."""


def residual_under(samples: Samples, orbits: Sequence[Orbit], record: ParameterSetRecord) -> Floats:
    """Return |corrected| - |model|, shape (n,), nT, of the usable ``samples`` under the parameters of ``record``.

    Raises
    ------
    ConflictError
        The parameter set has a regressor that counts from the start of its own data.
    InputError
        There is no reference field for the samples.
    """
    parameters = _parameters(record["parameters"])
    if TIME_REGRESSOR in map(source_of, parameters.regressors):
        raise ConflictError("the parameter set drifts with the time since its own data: it says nothing of others")
    used = samples.take(samples.is_used)
    thinned = used.take(slice(None, None, max(len(used) // MOST_SAMPLES, 1)))
    field = field_model(record["field_model"])
    referenced, _ = with_reference(thinned, orbits, field, time_offset_s=parameters.time_offset_s or 0.0)
    observations = Observations.of(referenced, tuple(parameters.regressors))
    return residuals_nt(observations, parameters, is_vector=False)


def _parameters(record: ParametersRecord) -> Parameters:
    return Parameters(
        bias_nt=np.array(record["bias_nt"], dtype=np.float64),
        scale=np.array(record["scale"], dtype=np.float64),
        nonorthogonality_deg=np.array(record["nonorthogonality_deg"], dtype=np.float64),
        time_offset_s=record["time_offset_s"],
        regressors={name: np.array(value, dtype=np.float64) for name, value in record["regressors"].items()},
    )

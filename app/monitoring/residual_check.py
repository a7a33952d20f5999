"""A session against a parameter set that need not come from it: is what is in force still right?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from app.errors import ConflictError
from app.records.parameter_set import ParameterSetRecord
from magcal_core.arrays import Floats
from magcal_core.field.sources import FieldSources
from magcal_core.observations import Observations, residuals_nt
from magcal_core.orbit import Orbit
from magcal_core.reference.averaging import BodyRate
from magcal_core.reference.columns import with_reference
from magcal_core.samples import Samples
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import NO_TIME_BASE, TIME_REGRESSOR
from magcal_core.sessions import averaged_as_in, field_of_record

MOST_SAMPLES: Final = 20_000
"""Samples that are looked at; a longer session is thinned evenly."""


def residual_under(
    samples: Samples, orbits: Sequence[Orbit], record: ParameterSetRecord, sources: FieldSources | None = None
) -> Floats:
    """Return |corrected| - |model|, shape (n,), nT, of the usable ``samples`` under the parameters of ``record``.

    ``sources``: the index and the coefficients that its field model needs.

    Raises
    ------
    ConflictError
        The parameter set drifts with time and does not say since when.
    InputError
        There is no reference field for the samples.
    """
    parameters = Parameters.from_record(record)
    is_since = parameters.follows_time and TIME_REGRESSOR not in samples.housekeeping
    if is_since and parameters.time_base_utc is None:
        raise ConflictError(NO_TIME_BASE)
    used = samples.take(samples.is_used)
    some = slice(None, None, max(len(used) // MOST_SAMPLES, 1))
    thinned, rate = used.take(some), BodyRate.of_attitude(used.t_utc, used.q_base_gcrf).take(some)
    field = field_of_record(dict(record), sources)
    referenced, _ = with_reference(thinned, orbits, field, time_offset_s=parameters.time_offset_s or 0.0)
    referenced, _ = averaged_as_in(dict(record), parameters, referenced, rate)
    if is_since:
        parameters = parameters.at_time_base(referenced.t_utc[referenced.is_used][0])
    observations = Observations.of(referenced, tuple(parameters.regressors))
    return residuals_nt(observations, parameters, is_vector=False)

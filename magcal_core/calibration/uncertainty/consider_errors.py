"""What errors of the reference do to the parameters: the part of the uncertainty that no residual shows.

Notes
-----
An error c of the reference moves the estimate by I^-1 J^T W c, whether or not it leaves a trace in the residuals: a
uniform external field is nearly a scale factor, an orbit that is late nearly an offset. Its size is known beforehand
(`error_budget`), its sign is not: it is *considered*, that is, the outer product of the shift by one standard deviation
is added to the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import rotate
from magcal_core.calibration.estimators.normal_equations import equations_at, scalar_responses
from magcal_core.calibration.estimators.scale_terms import without_scale_terms
from magcal_core.field.external_knowledge import ConsideredError
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations
from magcal_core.orbit.earth.earth_fixed import itrf_to_gcrf_fast
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.reference.error_budget import ReferenceSource, along_track_km
from magcal_core.samples import Samples
from magcal_core.sensor.parameters import Parameters

_PLACES: Final = 256
_STEP_KM: Final = 5.0
_MOST_STEP: Final = np.timedelta64(300, "s")
"""Longest time between neighbours whose positions tell the direction of flight."""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceShift:
    """By how much one source of error, at one standard deviation, moves the parameters, in the order of their names."""

    source: str
    why: str
    shift: Floats

    def to_dict(self, parameters: Parameters) -> dict[str, object]:
        """Return the source as the records have it."""
        sizes = parameters.with_vector(np.abs(self.shift))
        return {"source": self.source, "why": self.why, "standard_errors": sizes.to_dict()}


def reference_shifts(
    samples: Samples, observations: Observations, parameters: Parameters, source: ReferenceSource
) -> tuple[ReferenceShift, ...]:
    """Return what the considered errors of the reference do to the parameters.

    ``samples``: those that ``observations`` were made of, one for one. None where the reference came with the
    telemetry.
    """
    if samples.r_itrf_km is None or (source.is_vector and samples.q_base_gcrf is None):
        return ()
    placed = np.flatnonzero(np.isfinite(samples.r_itrf_km).all(axis=1) & (observations.weights > 0))
    rows = placed[:: max(1, len(placed) // _PLACES)]
    if len(rows) < 2:
        return ()
    few, some = samples.take(rows), replace(observations.take(rows), rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)
    errors = considered_errors(samples, rows, source)
    shifts = np.zeros((len(errors), len(parameters.names)))
    sizes = np.stack([one.error_nt for one in errors])
    # What the reference's errors do to the scale's changes is not told: they follow a column, not the place.
    some, parameters = without_scale_terms(some, parameters)
    moves = _vector_moves if source.is_vector else _scalar_moves
    found = moves(some, parameters, few, source.field.field_itrf_nt(few.t_utc, samples.r_itrf_km[rows]), sizes)
    shifts[:, : found.shape[1]] = found
    return tuple(ReferenceShift(one.source, one.why, shift) for one, shift in zip(errors, shifts, strict=True))


def considered_errors(samples: Samples, rows: NDArray[np.intp], source: ReferenceSource) -> tuple[ConsideredError, ...]:
    """Return the errors of the reference that are considered, by name: a vector at each of ``rows`` at one sigma.

    The three parts of the external field (`ExternalKnowledge`) and, where no clock was estimated, an orbit that is
    late. Their signs and sizes are independent of each other. ``samples`` are all those of the fit, of which ``rows``
    have a position.
    """
    if samples.r_itrf_km is None:
        return ()
    t_utc, r_km = samples.t_utc[rows], samples.r_itrf_km[rows]
    errors = source.known.errors(nanoseconds(samples.t_utc), nanoseconds(t_utc), r_km)
    if source.clock_error_s is not None or source.orbit_model == "telemetry-position":
        return errors
    along_km, how = along_track_km(samples, source)
    late_nt = along_km * _along_nt_per_km(source, t_utc, r_km, _directions(samples, rows))
    return (*errors, ConsideredError("orbit_along_track", f"{along_km:.2g} km ({how})", late_nt))


def _directions(samples: Samples, rows: NDArray[np.intp]) -> Floats:
    """Return the direction of flight along ITRF's axes at ``rows``, shape (n, 3), from neighbouring positions."""
    r_km = samples.r_itrf_km if samples.r_itrf_km is not None else np.zeros((0, 3))
    later, sooner = np.minimum(rows + 1, len(r_km) - 1), np.maximum(rows - 1, 0)
    ahead = r_km[later] - r_km[sooner]
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    is_near = samples.t_utc[later] - samples.t_utc[sooner] <= _MOST_STEP
    known = np.isfinite(length) & (length > 0) & is_near[:, None]
    return np.asarray(np.where(known, ahead / np.where(known, length, 1.0), 0.0))


def _along_nt_per_km(source: ReferenceSource, t_utc: Times, r_km: Floats, along: Floats) -> Floats:
    ahead = source.field.field_itrf_nt(t_utc, r_km + _STEP_KM * along)
    behind = source.field.field_itrf_nt(t_utc, r_km - _STEP_KM * along)
    return np.asarray((ahead - behind) / (2.0 * _STEP_KM))


def _scalar_moves(
    observations: Observations, parameters: Parameters, _samples: Samples, main_nt: Floats, errors_nt: Floats
) -> Floats:
    """Return the change of the parameters, shape (m, p), for errors of the reference, shape (m, n, 3), ITRF, nT."""
    along_field = np.einsum("mni,ni->nm", errors_nt, main_nt) / np.linalg.norm(main_nt, axis=1)[:, None]
    return scalar_responses(observations, parameters, along_field).T


def _vector_moves(
    observations: Observations, parameters: Parameters, samples: Samples, _main_nt: Floats, errors_nt: Floats
) -> Floats:
    """Return the same where components count."""
    q, b_nt = samples.q_base_gcrf, observations.require_vector()
    here = equations_at(observations, parameters, is_vector=True)
    inverse, moves = scaled_inverse(here.normal), []
    for error_nt in errors_nt:
        in_base = rotate(q, itrf_to_gcrf_fast(samples.t_utc, error_nt)) if q is not None else error_nt
        there = equations_at(replace(observations, b_base_nt=b_nt + in_base), parameters, is_vector=True)
        moves.append(-inverse @ (there.gradient - here.gradient))
    return np.array(moves)

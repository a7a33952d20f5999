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
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.linear_rows import Rows, rows_of
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


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceErrors:
    """Errors of the reference at one standard deviation, at some samples that stand for all.

    Attributes
    ----------
    rows : shape (r,)
        Which samples these are.
    errors_nt : shape (m, r, 3)
        Each error, ITRF, nT.
    main_nt : shape (r, 3)
        The field that it is an error of, ITRF, nT.
    in_base_nt : shape (m, r, 3), optional
        Each error in the base frame, nT, where attitude is known.
    named : (source, why) of each.
    """

    rows: NDArray[np.intp]
    errors_nt: Floats
    main_nt: Floats
    in_base_nt: Floats | None
    named: tuple[tuple[str, str], ...]

    def without(self, source: str) -> ReferenceErrors | None:
        """Return the errors but that of ``source``; None where none is left."""
        kept = [i for i, (name, _) in enumerate(self.named) if name != source]
        if not kept:
            return None
        in_base = None if self.in_base_nt is None else self.in_base_nt[kept]
        return replace(
            self, errors_nt=self.errors_nt[kept], in_base_nt=in_base, named=tuple(self.named[i] for i in kept)
        )

    def moves(self, observations: Observations, fit: Fit, *, is_full: bool = False) -> tuple[Rows, Floats]:
        """Return the rows of these samples and how far each error moves their unknowns, shape (m, q).

        ``observations``, ``fit``: all samples, with the derivative of the reference where the clock is an unknown.
        """
        few = observations.take(self.rows)
        part = replace(fit, residuals_nt=fit.residuals_nt[self.rows], weights=fit.weights[self.rows])
        linear = rows_of(few, part, is_full=is_full)
        if fit.residuals_nt.ndim == 1:
            along = np.einsum("mni,ni->mn", self.errors_nt, self.main_nt) / np.linalg.norm(self.main_nt, axis=1)
            changes = along[None]
        else:
            in_base = self.errors_nt if self.in_base_nt is None else self.in_base_nt
            changes = np.einsum("mnj,ij->imn", in_base, linear.matrix)
        q = linear.unknowns.size
        normal, right = np.zeros((q, q)), np.zeros((len(self.errors_nt), q))
        for channel, change in zip(linear.channels, changes, strict=True):
            normal[np.ix_(channel.places, channel.places)] += channel.jacobian.T @ channel.jacobian
            right[:, channel.places] += (change * channel.by_field) @ channel.jacobian
        return linear, right @ scaled_inverse(normal)


def reference_errors(samples: Samples, weights: Floats, source: ReferenceSource) -> ReferenceErrors | None:
    """Return an external field and, where no clock was estimated, an orbit that is late, as errors of the reference.

    ``samples``: those of the fit, and their ``weights``, shape (n,). None where the reference came with the telemetry.
    """
    if samples.r_itrf_km is None or (source.is_vector and samples.q_base_gcrf is None):
        return None
    placed = np.flatnonzero(np.isfinite(samples.r_itrf_km).all(axis=1) & (weights > 0))
    rows = placed[:: max(1, len(placed) // _PLACES)]
    if len(rows) < 2:
        return None
    few = samples.take(rows)
    t_utc, r_km = few.t_utc, samples.r_itrf_km[rows]
    errors = considered_errors(samples, rows, source)
    sizes = np.stack([one.error_nt for one in errors])
    in_base, q = None, few.q_base_gcrf
    if source.is_vector and q is not None:
        in_base = np.stack([rotate(q, itrf_to_gcrf_fast(t_utc, error_nt)) for error_nt in sizes])
    named = tuple((one.source, one.why) for one in errors)
    return ReferenceErrors(rows, sizes, source.field.field_itrf_nt(t_utc, r_km), in_base, named)


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


def reference_shifts(
    errors: ReferenceErrors | None, observations: Observations, fit: Fit
) -> tuple[ReferenceShift, ...]:
    """Return what each error does to the parameters of ``fit``, in the order of their names; none for no errors.

    Where the clock is an unknown, its error is among them: the one that is still there after it was fitted.
    """
    if errors is None:
        return ()
    linear, moves = errors.moves(observations, fit)
    shifts = moves @ linear.unknowns.to_parameters(linear.matrix).T
    return tuple(ReferenceShift(*named, shift) for named, shift in zip(errors.named, shifts, strict=True))


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

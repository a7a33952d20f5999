"""One session with what the errors of its bias may be locked to, and the clock beside them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.linear_rows import Moments
from magcal_core.calibration.observability.information import ENOUGH
from magcal_core.calibration.terms.coarse_clock import POOR, CoarseClock, coarse_clock, quadric_share
from magcal_core.calibration.terms.heat_columns import light_along
from magcal_core.calibration.terms.locked import Kind, LockedTerms, locked_terms
from magcal_core.calibration.terms.locked_clock import RATE_STEP_S, ClockSearch, with_derivative
from magcal_core.calibration.terms.locked_columns import (
    LockedColumns,
    Surroundings,
    locked_columns,
    no_columns,
    surroundings_of,
)
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors, reference_errors
from magcal_core.calibration.uncertainty.honest_covariance import covered_s
from magcal_core.errors import IndexRangeError, ModelRangeError, OrbitMissingError
from magcal_core.observations import Observations, corrected_nt
from magcal_core.reference.error_budget import DRIFT_KM_PER_DAY, EPHEMERIS_KM, EPOCH_ERROR_KM, ReferenceSource
from magcal_core.reference.referenced_samples import MovableObservations, Referenced
from magcal_core.reference.shifted_times import MovingReference
from magcal_core.samples import Samples
from magcal_core.sensor.regressors import TIME_REGRESSOR

SPEED_KM_S: Final = 7.6
"""Speed of a low orbit: what turns an error along the track into one of time."""


@dataclass(frozen=True, eq=False)
class LockedSession:
    """The samples of a session that a method uses, with their surroundings.

    Attributes
    ----------
    referenced : Referenced
    usable : shape (n,)
        Samples of the session that the method uses.
    is_vector : bool
    """

    referenced: Referenced
    usable: NDArray[np.bool_]
    is_vector: bool
    _columns: dict[int, tuple[Fit, LockedColumns | None]] = field(default_factory=dict, init=False)

    @cached_property
    def samples(self) -> Samples:
        """The usable samples."""
        return self.referenced.samples.take(self.usable)

    @cached_property
    def around(self) -> Surroundings:
        """Place and sun at the usable samples."""
        return surroundings_of(self.samples, self.referenced.orbits, self.referenced.field)

    def light(self, offset_s: float) -> Floats | None:
        """Return 1 in the sun and 0 in the umbra, shape (n,), of the usable samples at a clock's offset, s."""
        if offset_s == 0.0 or not self.referenced.has_orbit:
            return self.around.light
        t_utc = self.samples.t_utc + np.timedelta64(round(offset_s * 1e9), "ns")
        return light_along(t_utc, self.referenced.orbits)

    def source(self, clock_error_s: float | None) -> ReferenceSource:
        """Return where the reference came from."""
        one = self.referenced
        return ReferenceSource(
            one.report.orbit_model,
            one.age_days,
            one.field,
            self.is_vector,
            clock_error_s,
            one.report.interpolation_km,
            one.external,
        )

    @cached_property
    def _errors(self) -> ReferenceErrors | None:
        """Errors of the reference at samples that may be used, that of the orbit along its track among them."""
        return reference_errors(self.samples, np.ones(len(self.samples)), self.source(None))

    def errors(self, clock: float | None) -> ReferenceErrors | None:
        """Return the errors of the reference that are considered; ``clock``: standard error of one that is known, s."""
        if clock is None or self._errors is None:
            return self._errors
        return self._errors.without("orbit_along_track")

    def columns(self, observations: Observations, fit: Fit) -> LockedColumns | None:
        """Return the locked columns; None where nothing is known that a bias could be locked to."""
        known = self._columns.get(id(fit))
        if known is not None and known[0] is fit:
            return known[1]
        x_nt = corrected_nt(observations, fit.parameters)
        unit = x_nt / np.linalg.norm(x_nt, axis=1)[:, None]
        has_time = TIME_REGRESSOR in observations.regressors
        made = locked_columns(observations.t_s, self.around, unit, fit.weights > 0, has_time=has_time)
        self._columns[id(fit)] = (fit, made)
        return made

    def terms(
        self,
        observations: Observations,
        fit: Fit,
        *,
        has_clock: bool,
        stays: bool = False,
        known: Moments | None = None,
    ) -> LockedTerms | None:
        """Return the estimate with locked errors considered; None where there is nothing that they are locked to.

        ``has_clock``: the clock is one unknown more, and ``observations`` have the derivative of the reference by it.
        ``stays``: the estimate does not move, only its errors are asked for; ``known``: the moments of the fit,
        where they have been taken already.
        """
        columns = self.columns(observations, fit)
        if columns is None:
            return None
        kind: Kind = "clock" if has_clock else "fit"
        return locked_terms(observations, fit, columns, covered_s(observations.t_s), kind, never=stays, known=known)

    def thinned(self) -> tuple[LockedSession, slice]:
        """Return the session with at most some `ENOUGH` of its samples, evenly spaced, and which of them these are."""
        rows = np.flatnonzero(self.usable)
        step = max(1, len(rows) // ENOUGH)
        if step == 1:
            return self, slice(None)
        few = np.zeros_like(self.usable)
        few[rows[::step]] = True
        return replace(self, usable=few), slice(None, None, step)

    def clock_search(
        self, estimator: Estimator, settings: FitSettings, observations: Observations, fit: Fit
    ) -> ClockSearch:
        """Return the search for the clock; ``fit``: the plain one to ``observations``, at the telemetry's own times."""
        names = tuple(observations.regressors)
        ready: list[MovableObservations] = []

        def at(shift_s: Floats, rows: slice) -> Observations:
            # Made ready once it is asked for: most sessions need no search.
            if not ready:
                ready.append(self.referenced.movable(self.usable, names))
            return ready[0].at(shift_s, rows)

        columns = self.columns(observations, fit)
        known = no_columns(len(observations)) if columns is None else columns
        errors = self.errors(0.0)
        # Drag is left out: what it does over weeks is an offset that is to be found.
        is_old = "oem" not in self.referenced.report.orbit_model
        along_km = EPOCH_ERROR_KM + DRIFT_KM_PER_DAY * self.referenced.age_days if is_old else EPHEMERIS_KM
        along_s = along_km / SPEED_KM_S
        return ClockSearch(estimator, settings, at, known, errors, self.around.period_s, along_s)

    def coarse_clock(self, observations: Observations, *, is_clean: bool) -> CoarseClock | None:
        """Return a clock that is minutes or hours off, where the readings' quadric does not suit the field.

        ``is_clean``: no row is bad.
        """
        if not self.referenced.has_orbit or quadric_share(observations) < POOR:
            return None
        t_utc = self.samples.t_utc
        one = self.referenced
        moving = MovingReference.about(t_utc, one.orbits, one.field, is_gcrf=False, uses=1)
        return coarse_clock(observations, t_utc, lambda times: moving.at(times, None)[0], is_clean=is_clean)

    def at_offset(self, names: tuple[str, ...], offset_s: float) -> Observations | None:
        """Return the observations with the reference at a clock's offset; None where no orbit reaches there."""
        shift_s = np.full(int(np.count_nonzero(self.usable)), offset_s)
        with suppress(OrbitMissingError, ModelRangeError, IndexRangeError):
            return self.referenced.shifted(self.usable, names, shift_s)
        return None

    def with_rates(self, observations: Observations, offset_s: float) -> Observations:
        """Return ``observations``, whose reference is at ``offset_s``, with its derivative by the clock's offset."""
        movable, n = self.referenced.beside(observations, self.usable), len(observations)
        with suppress(OrbitMissingError, ModelRangeError, IndexRangeError):
            later, sooner = (movable.at(np.full(n, offset_s + step_s)) for step_s in (RATE_STEP_S, -RATE_STEP_S))
            return with_derivative(observations, later, sooner)
        return observations

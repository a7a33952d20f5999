"""Samples in time order with their reference field, which can be recomputed at shifted times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.errors import TooManyBadSamplesError
from magcal_core.field import FieldModel
from magcal_core.field.external_knowledge import ExternalKnowledge
from magcal_core.field.models import field_model
from magcal_core.field.sources import FieldSources
from magcal_core.observations import Observations
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.reference.averaging import Averaging, averaged_by_attitude
from magcal_core.reference.columns import (
    TELEMETRY_POSITION,
    TELEMETRY_REFERENCE,
    ReferenceReport,
    finite_rows,
    with_reference,
)
from magcal_core.reference.shifted_times import MovingReference
from magcal_core.samples import SampleFlag, Samples
from magcal_core.sensor.regressors import OF_SCALE, TIME_REGRESSOR, lag_of, lagged, source_of
from magcal_core.telemetry.screen import screened, unscreened

MAX_BAD_FRACTION: Final = 0.5
"""Share of readings that are not finite or hold a fill value from which on the data are refused."""

_USES: Final = 4
"""How often a search for the clock asks for the reference at least: twice about each of two places."""


def in_time_order(samples: Samples, *, is_plain: bool = False) -> Samples:
    """Return the samples in time order, equal times by their readings, with rows flagged that cannot be readings.

    ``is_plain``: only rows without a reading are, as the plain fit of published figures has it.

    Raises
    ------
    TooManyBadSamplesError
        More than `MAX_BAD_FRACTION` of the readings are not finite or hold a fill value.
    """
    h, t_utc = samples.h_nt, samples.t_utc
    ordered = samples
    if not np.all(t_utc[1:] > t_utc[:-1]):
        ordered = samples.take(np.lexsort((h[:, 2], h[:, 1], h[:, 0], t_utc)))
    is_bad = ~finite_rows(ordered.h_nt) | np.isnat(ordered.t_utc)
    marked = ordered.flagged(SampleFlag.NOT_FINITE, is_bad) if is_bad.any() else ordered
    found = unscreened(marked) if is_plain else screened(marked)
    is_empty = (found.flags & np.uint16(SampleFlag.NOT_FINITE | SampleFlag.FILL_VALUE)) != 0
    bad = int(np.count_nonzero(is_empty))
    if bad and bad >= MAX_BAD_FRACTION * len(samples):
        raise TooManyBadSamplesError(
            f"{bad} of {len(samples)} readings are empty, not finite or fill values, limit {MAX_BAD_FRACTION:.0%}"
        )
    return found


class ReferenceOptions(Protocol):
    """What the options of a calibration say of the reference."""

    @property
    def field(self) -> str:
        """Field model by name."""
        ...

    @property
    def field_max_degree(self) -> int | None:
        """Degree that the model is cut at, None for its own."""
        ...

    @property
    def index_gap(self) -> str:
        """What is done where the index of the external field has no value."""
        ...

    @property
    def quiet_only(self) -> bool:
        """Whether only samples of quiet hours count."""
        ...

    @property
    def orbit(self) -> str:
        """``sgp4`` as the elements are meant, or ``numerical``."""
        ...

    @property
    def max_orbit_age_days(self) -> float:
        """Orbits further from the data are refused, days."""
        ...

    @property
    def integration_s(self) -> float | None:
        """Time over which the sensor averages a reading, s; None or 0: it does not."""
        ...

    @property
    def is_plain(self) -> bool:
        """Whether every reading counts, as for the plain fit of published figures."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Referenced:
    """Samples with their reference field.

    Attributes
    ----------
    samples : Samples
        In time order, with reference columns.
    report : ReferenceReport
        Where the reference came from.
    orbits, field
        What it was computed with.
    external : ExternalKnowledge
        What is known of the external field beside the model.
    averaging : Averaging, optional
        How the reference was averaged over the sensor's integration time, where it has one.
    """

    samples: Samples
    report: ReferenceReport
    orbits: Sequence[Orbit]
    field: FieldModel
    external: ExternalKnowledge
    averaging: Averaging | None = None

    @classmethod
    def of(
        cls,
        samples: Samples,
        orbits: Sequence[Orbit],
        options: ReferenceOptions,
        sources: FieldSources | None = None,
    ) -> Referenced:
        """Return ``samples`` in time order with their reference, of which ``sources`` have index and coefficients.

        Raises
        ------
        InputError
            What `in_time_order` and `with_reference` raise.
        """
        ordered = in_time_order(samples, is_plain=options.is_plain)
        at_hand = FieldSources() if sources is None else sources
        field = field_model(options.field, options.field_max_degree, index_gap=options.index_gap, sources=at_hand)
        external = ExternalKnowledge.of(field, at_hand)
        # An instant that is not one has no place: it is kept out before the orbit is asked for it.
        known = ordered.take(~np.isnat(ordered.t_utc))
        if options.quiet_only:
            known = known.flagged(SampleFlag.NOT_QUIET, external.not_quiet(nanoseconds(known.t_utc)))
        used = _numerical(orbits, known) if options.orbit == "numerical" else list(orbits)
        filled, report = with_reference(known, used, field, max_orbit_age_days=options.max_orbit_age_days)
        averaged, averaging = averaged_by_attitude(filled, options.integration_s)
        return cls(averaged, report, used, field, external, averaging)

    @property
    def age_days(self) -> float:
        """Largest distance between data and orbit, days; 0 where no orbit was used."""
        return max((float(str(orbit["age_days"])) for orbit in self.report.orbits), default=0.0)

    def placed(self) -> tuple[NDArray[np.int64], Floats]:
        """Return times, nanoseconds since 1970, and places, shape (n, 3), ITRF, km, of the samples that count.

        None of them where the reference came with the telemetry.
        """
        r_km = self.samples.r_itrf_km
        if r_km is None or self.report.orbit_model == TELEMETRY_REFERENCE:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        rows = self.samples.is_used & finite_rows(r_km)
        if rows.all():
            return nanoseconds(self.samples.t_utc), r_km
        return nanoseconds(self.samples.t_utc[rows]), r_km[rows]

    @property
    def has_orbit(self) -> bool:
        """Whether orbits gave all positions: only then their clock and the telemetry's can differ."""
        return bool(self.report.orbits) and TELEMETRY_POSITION not in self.report.orbit_model

    def usable(self, regressors: Sequence[str], is_vector: bool) -> NDArray[np.bool_]:
        """Return which samples a method can use with these regressors, shape (n,)."""
        samples = self.samples
        usable = samples.is_used.copy()
        if samples.b_ref_magnitude_nt is not None:
            usable &= np.isfinite(samples.b_ref_magnitude_nt)
        if is_vector and samples.b_ref_base_nt is not None:
            usable &= finite_rows(samples.b_ref_base_nt)
        return usable & has_columns(samples, regressors)

    def observations(self, usable: NDArray[np.bool_], regressors: Sequence[str]) -> Observations:
        """Return the ``usable`` samples as an estimator sees them; without attitude where some of them have none."""
        seen = replace(_observed(oriented(self.samples, usable)), q_base_gcrf=None)
        return Observations.of(seen, regressors, usable.astype(np.float64))

    def shifted(
        self, usable: NDArray[np.bool_], regressors: Sequence[str], shift_s: Floats, rows: slice = slice(None)
    ) -> Observations:
        """Return the same with the reference at times that are ``shift_s``, shape (usable,), s, after the clock's.

        ``rows``: which of the usable samples; ``shift_s`` is theirs.
        """
        return self._movable(usable, regressors, rows, uses=1).at(shift_s)

    def movable(self, usable: NDArray[np.bool_], regressors: Sequence[str]) -> MovableObservations:
        """Return the same, made ready to be asked for the reference at shifted times again and again."""
        return self._movable(usable, regressors, slice(None), uses=_USES)

    def _movable(
        self, usable: NDArray[np.bool_], regressors: Sequence[str], rows: slice, *, uses: int
    ) -> MovableObservations:
        # Of all samples: a column at a lag, or a slope, needs the neighbours of the usable ones.
        return self.beside(self.observations(usable, regressors), usable, rows, uses=uses)

    def beside(
        self, unmoved: Observations, usable: NDArray[np.bool_], rows: slice = slice(None), *, uses: int = 1
    ) -> MovableObservations:
        """Return ``unmoved``, the observations of the ``usable`` samples, to be asked for the reference at other times.

        ``rows``: which of them; ``uses``: how often they will be asked, at least.
        """
        t_utc, q = self.samples.t_utc[usable], None
        if unmoved.b_base_nt is not None and self.samples.q_base_gcrf is not None:
            q = self.samples.q_base_gcrf[usable]
        averaging = None if self.averaging is None else self.averaging.take(usable).take(rows)
        if rows != slice(None):
            unmoved, t_utc, q = unmoved.take(rows), t_utc[rows], None if q is None else q[rows]
        reference = MovingReference.about(t_utc, self.orbits, self.field, is_gcrf=q is not None, uses=uses)
        return MovableObservations(unmoved, t_utc, q, reference, averaging)


def has_columns(samples: Samples, regressors: Sequence[str]) -> NDArray[np.bool_]:
    """Return which samples, in time order, have a value of every column that ``regressors`` name, at its lag."""
    has = np.ones(len(samples), dtype=bool)
    t_s: Floats | None = None
    for name in regressors:
        source = source_of(name)
        if source not in samples.housekeeping and source != TIME_REGRESSOR:
            continue
        lag = lag_of(name.removesuffix(OF_SCALE))[1]
        if lag and t_s is None and len(samples):
            t_s = (samples.t_utc - samples.t_utc[0]) / np.timedelta64(1, "ns") * 1e-9
        column = np.asarray(samples.housekeeping.get(source, np.zeros(len(samples))), np.float64)
        has &= np.isfinite(column if t_s is None else lagged(column, lag, t_s))
    return has


@dataclass(frozen=True, slots=True, eq=False)
class MovableObservations:
    """Observations whose reference can be recomputed at shifted times.

    Attributes
    ----------
    unmoved : Observations
        With the reference at the telemetry's own times.
    t_utc : datetime64[ns], shape (n,)
        These times.
    q_base_gcrf : shape (n, 4), optional
        Unit quaternion, scalar first: ``v_base = C(q) v_gcrf``.
    reference : MovingReference
        The reference at other times.
    averaging : Averaging, optional
        What the sensor's integration time makes of it.
    """

    unmoved: Observations
    t_utc: Times
    q_base_gcrf: Floats | None
    reference: MovingReference
    averaging: Averaging | None = None

    def at(self, shift_s: Floats, rows: slice = slice(None)) -> Observations:
        """Return the observations ``rows`` with the reference ``shift_s``, shape (rows,), s, after the clock's time.

        Raises
        ------
        OrbitMissingError
            No orbit covers a shifted time.
        """
        moved = self.t_utc[rows] + np.round(shift_s * 1e9).astype("timedelta64[ns]")
        b_nt, b_base_nt = self.reference.at(moved, None if self.q_base_gcrf is None else self.q_base_gcrf[rows])
        if self.averaging is not None:
            b_nt, b_base_nt = self.averaging.take(rows).of_reference(b_nt, b_base_nt)
        here = self.unmoved if rows == slice(None) else self.unmoved.take(rows)
        return replace(here, b_nt=b_nt, b_base_nt=b_base_nt)


def oriented(samples: Samples, usable: NDArray[np.bool_]) -> Samples:
    """Return ``samples`` with the field in the base frame only where all of the ``usable`` ones have it."""
    base_nt = samples.b_ref_base_nt
    if base_nt is None or np.all(finite_rows(base_nt) | ~usable):
        return samples
    return replace(samples, b_ref_base_nt=None)


def _observed(samples: Samples) -> Samples:
    """Return ``samples`` without the columns that no estimator sees: selecting among them need not copy these."""
    return replace(samples, r_itrf_km=None, b_ref_gcrf_nt=None)


def _numerical(orbits: Sequence[Orbit], samples: Samples) -> list[Orbit]:
    """Return numerical orbits in place of those of ``orbits`` that give some sample its position."""
    from magcal_core.orbit.numerical_fit import numerical_orbits

    needs_orbit = bool(orbits) and not samples.has_reference and samples.r_itrf_km is None
    return numerical_orbits(orbits, samples.t_utc) if needs_orbit else list(orbits)

"""The energy balance of an orbit or of state rows: H, its spread and drift, every term, and what can be recovered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.energy.forms import hamiltonian_m2_s2
from magcal_core.energy.options import EnergyOptions
from magcal_core.energy.recovery import Recovery, recover
from magcal_core.energy.terms import Track, balance_terms
from magcal_core.errors import OrbitFormatError
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.bodies import default_ephemeris
from magcal_core.orbit.earth.frames import Frame
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.propagators.forces import ExponentialDrag, force_tables
from magcal_core.orbit.propagators.gravity import egm96
from magcal_core.orbit.propagators.numerical import NumericalOrbit

INTEGRATION_RTOL: Final = 1e-13
"""Tolerance of orbits whose balance is taken: H then keeps to 1e-5 m2/s2 a day."""
CONSISTENT_M2_S2: Final = 0.1
"""Std of H below which frames, potential and integrator agree (ENERGY)."""
INCONSISTENT_M2_S2: Final = 1.0

_FINE_STEP_S: Final = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class StateRows:
    """Positions and velocities in time order, from whatever gave them.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (n,)
        UTC, increasing.
    r_gcrf_km, v_gcrf_km_s : shape (n, 3)
        GCRF, km and km/s.
    a_nongravitational_km_s2 : shape (n, 3), optional
        What an accelerometer measured, GCRF, km/s2.

    Raises
    ------
    OrbitFormatError
        Shapes differ, a value is not finite, times do not increase, or there are fewer than three rows.
    """

    t_utc: Times
    r_gcrf_km: Floats
    v_gcrf_km_s: Floats
    a_nongravitational_km_s2: Floats | None = None
    model: str = "rows"

    def __post_init__(self) -> None:
        n = len(self.t_utc)
        if n < 3:
            raise OrbitFormatError(f"{n} states; an energy balance needs 3 or more")
        for name in ("r_gcrf_km", "v_gcrf_km_s", "a_nongravitational_km_s2"):
            column: Floats | None = getattr(self, name)
            if column is not None and (column.shape != (n, 3) or not np.all(np.isfinite(column))):
                raise OrbitFormatError(f"{name} has shape {column.shape}; want ({n}, 3), every value finite")
        if not np.all(np.diff(nanoseconds(self.t_utc)) > 0):
            raise OrbitFormatError("the times of the states do not increase")


@dataclass(frozen=True, slots=True)
class Spread:
    """How a series lies: mean, standard deviation and peak to peak, m2/s2."""

    mean: float
    std: float
    peak_to_peak: float

    @classmethod
    def of(cls, series_m2_s2: Floats) -> Spread:
        """Return the spread of a series, shape (n,), m2/s2."""
        return cls(float(series_m2_s2.mean()), float(series_m2_s2.std()), float(np.ptp(series_m2_s2)))

    def to_dict(self) -> dict[str, float]:
        """Return it as JSON takes it."""
        return {"mean": self.mean, "std": self.std, "peak_to_peak": self.peak_to_peak}


@dataclass(frozen=True, slots=True, eq=False)
class EnergyBalance:
    """The balance along a track.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (n,)
    hamiltonian_m2_s2 : shape (n,)
        H in the form that was asked for.
    terms : name -> shape (n,)
        Series of `magcal_core.energy.terms.balance_terms`, m2/s2.
    drift_m2_s2_per_day : float
        Slope of H; for rows without accelerations it estimates the dissipation.
    """

    options: EnergyOptions
    orbit_model: str
    t_utc: Times
    hamiltonian_m2_s2: Floats
    terms: Mapping[str, Floats]
    drift_m2_s2_per_day: float
    recovery: Recovery | None
    warnings: tuple[str, ...]

    @property
    def spread(self) -> Spread:
        """Spread of H."""
        return Spread.of(self.hamiltonian_m2_s2)

    @property
    def frame_free(self) -> Spread:
        """Spread of H with the change of the Earth's rotation vector taken along (`frame_rate_m2_s2`)."""
        return Spread.of(self.hamiltonian_m2_s2 + self.terms["frame_rate"])

    @property
    def consistency(self) -> str:
        """``consistent`` (`frame_free` has a std below 0.1 m2/s2), ``doubtful`` (below 1) or ``inconsistent``."""
        std = self.frame_free.std
        return "consistent" if std < CONSISTENT_M2_S2 else "doubtful" if std < INCONSISTENT_M2_S2 else "inconsistent"

    def to_dict(self) -> dict[str, object]:
        """Return the result of ``magcal energy --json``; the series themselves are left out."""
        return {
            "hamiltonian": {
                "mean_m2_s2": self.spread.mean,
                "std_m2_s2": self.spread.std,
                "peak_to_peak_m2_s2": self.spread.peak_to_peak,
                "drift_m2_s2_per_day": self.drift_m2_s2_per_day,
                "std_frame_rate_removed_m2_s2": self.frame_free.std,
                "consistency": self.consistency,
            },
            "terms": {name: Spread.of(series).to_dict() for name, series in self.terms.items()},
            "recovery": None if self.recovery is None else self.recovery.to_dict(),
            "samples": len(self.t_utc),
            "orbit_model": self.orbit_model,
            "warnings": list(self.warnings),
            "options": self.options.to_dict(),
        }

    def columns(self) -> dict[str, Floats]:
        """Return the series beside ``t_utc`` as columns of a table: ``hamiltonian`` and every term, m2/s2."""
        return {"hamiltonian": self.hamiltonian_m2_s2, **self.terms}


def integrated(
    epoch_utc: np.datetime64,
    r_km: Floats,
    v_km_s: Floats,
    options: EnergyOptions,
    frame: Frame = "GCRF",
    *,
    drag: ExponentialDrag | None = None,
) -> NumericalOrbit:
    """Return the orbit through a state with the forces that ``options`` name, integrated tightly enough for a balance.

    ``drag`` acts where the options name none.

    Raises
    ------
    OrbitFormatError, FrameError
        The state is not one.
    """
    if options.drag_density_kg_m3 > 0.0 and options.drag_area_over_mass_m2_kg > 0.0:
        drag = ExponentialDrag(
            options.drag_density_kg_m3,
            options.drag_area_over_mass_m2_kg,
            float(np.linalg.norm(r_km)),
            options.drag_scale_height_km,
        )
    return NumericalOrbit.from_state(
        epoch_utc,
        r_km,
        v_km_s,
        frame,
        degree=options.degree,
        third_bodies=options.third_bodies,
        tide=options.tide,
        drag=drag,
        rtol=INTEGRATION_RTOL,
        rotation=options.rotation,
    )


def sampled(orbit: Orbit, intervals: int, step_s: float) -> StateRows:
    """Return ``intervals`` + 1 states of ``orbit`` from its epoch on, ``step_s`` apart."""
    offsets_ns = np.round(np.arange(intervals + 1) * step_s * 1e9).astype(np.int64)
    t_utc = (int(nanoseconds(np.array([orbit.epoch_utc]))[0]) + offsets_ns).view("datetime64[ns]")
    r_km, v_km_s = orbit.state_gcrf(t_utc)
    drag_km_s2 = orbit.drag_acceleration_km_s2(t_utc) if isinstance(orbit, NumericalOrbit) else None
    return StateRows(t_utc, r_km, v_km_s, drag_km_s2, orbit.model)


def energy_balance(source: Orbit | StateRows, options: EnergyOptions) -> EnergyBalance:
    """Return the energy balance of an orbit from its epoch on, or of rows of states as they are.

    A numerical orbit is integrated again from its state, and SGP4 from its state at its epoch (unless ``options.orbit``
    is ``sgp4``), with the forces that ``options`` name; the drag of a numerical orbit stays where they name none. An
    ephemeris and rows are balanced as they are; rows keep their own times, so ``duration_s`` and ``step_s`` have no
    effect on them.

    Raises
    ------
    PropagationError, ModelRangeError
        The orbit, Earth orientation or the ephemeris does not reach.
    OrbitFormatError
        Rows that cannot be a track.
    EstimationError
        The samples do not determine the coefficients asked for.
    """
    source = _integrated_anew(source, options)
    track, t_utc, thin = _track(source, options)
    terms = balance_terms(track)
    series = hamiltonian_m2_s2(track, terms, options.form)
    kept = track.every(thin)
    kept_terms = {name: values[::thin] for name, values in terms.items()}
    days = kept.t_s / 86400.0
    recovery = None if options.recover is None else recover(kept, kept_terms, options)
    return EnergyBalance(
        options=options,
        orbit_model=source.model,
        t_utc=t_utc[::thin],
        hamiltonian_m2_s2=series[::thin],
        terms=kept_terms,
        drift_m2_s2_per_day=float(np.polyfit(days - days.mean(), series[::thin] - series.mean(), 1)[0]),
        recovery=recovery,
        warnings=_warnings(source, options),
    )


def _integrated_anew(source: Orbit | StateRows, options: EnergyOptions) -> Orbit | StateRows:
    if isinstance(source, NumericalOrbit):
        r_km, v_km_s = np.split(source.state_km_km_s, 2)
        return integrated(source.epoch_utc, r_km, v_km_s, options, drag=source.drag)
    if isinstance(source, StateRows) or source.model != "sgp4" or options.orbit == "sgp4":
        return source
    r_gcrf_km, v_gcrf_km_s = source.state_gcrf(np.array([source.epoch_utc], "datetime64[ns]"))
    return integrated(source.epoch_utc, r_gcrf_km[0], v_gcrf_km_s[0], options)


def _track(source: Orbit | StateRows, options: EnergyOptions) -> tuple[Track, Times, int]:
    """Return the track on a grid fine enough for the work integrals, its times, and which rows were asked for."""
    if isinstance(source, StateRows):
        rows, thin = source, 1
    else:
        thin = int(np.ceil(options.step_s / _FINE_STEP_S))
        intervals = int(options.duration_s / options.step_s + 1e-9)
        rows = sampled(source, intervals * thin, options.step_s / thin)
    epoch_utc = source.epoch_utc if isinstance(source, NumericalOrbit) else rows.t_utc[0]
    t_s = (nanoseconds(rows.t_utc) - nanoseconds(np.array([epoch_utc]))[0]) / 1e9
    if isinstance(source, NumericalOrbit):
        tables, field = source.tables(t_s[0], t_s[-1]), source.field
        acts = source.has_third_bodies, source.has_tide
    else:
        tables = force_tables(epoch_utc, t_s[0], t_s[-1], default_ephemeris(), options.rotation)
        field, acts = egm96(options.degree), (options.third_bodies, options.tide)
    a_km_s2 = rows.a_nongravitational_km_s2
    if a_km_s2 is None:
        a_km_s2 = np.zeros_like(rows.r_gcrf_km)
    return Track(t_s, rows.r_gcrf_km, rows.v_gcrf_km_s, a_km_s2, tables, field, *acts), rows.t_utc, thin


def _warnings(source: Orbit | StateRows, options: EnergyOptions) -> tuple[str, ...]:
    found = []
    if source.model == "sgp4":
        found.append("sgp4_velocity: SGP4 is 1 m/s off, which is 7.6e3 m2/s2: no test of frames or field")
    measured = isinstance(source, StateRows) and source.a_nongravitational_km_s2 is not None
    if not measured and not isinstance(source, NumericalOrbit):
        found.append("dissipation_estimated: no accelerations were given; the drift of H is the estimate of their work")
    if options.form != "corrected":
        found.append(f"form: {options.form} is for comparison; the balance is the form 'corrected'")
    return tuple(found)

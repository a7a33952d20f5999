"""Several sessions and several sensors, from telemetry to result: joint fits, monitoring, comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.loss import AUTO, AUTO_LOSS, fit_under_loss
from magcal_core.calibration.estimators.registry import ESTIMATORS, is_vector_method
from magcal_core.calibration.sessions.joint import DEFAULT_SHARED, JointFit, joint_fit
from magcal_core.calibration.sessions.monitoring import ActiveSet, SessionJudgement, judge_session
from magcal_core.calibration.sessions.two_magnetometers import Comparison, CorrectedReadings, compare_magnetometers
from magcal_core.errors import EstimationError, OptionError
from magcal_core.estimation.averaging import averaging_by_gyros, rate_by_gyros
from magcal_core.estimation.session import LockedSession
from magcal_core.estimation.surrounded_session import SurroundedSession
from magcal_core.field import FieldModel
from magcal_core.field.external_knowledge import ExternalKnowledge
from magcal_core.field.models import field_model
from magcal_core.field.sources import FieldSources
from magcal_core.observations import Observations, corrected_nt
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.reference.averaging import GYROS, Averaging, BodyRate
from magcal_core.reference.columns import with_reference
from magcal_core.reference.referenced_samples import Referenced, has_columns, in_time_order, oriented
from magcal_core.reference.rows_asked_for import rows_asked_for
from magcal_core.samples import Samples
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import (
    NO_TIME_BASE,
    TIME_REGRESSOR,
    hours_since,
    is_of_scale,
    missing_columns,
    regressor_of,
    with_steps,
    with_time,
)


def calibrate_jointly(
    sessions: Mapping[str, Samples],
    orbits: Sequence[Orbit] = (),
    options: CalibrationOptions | None = None,
    *,
    shared: Sequence[str] = DEFAULT_SHARED,
    time_offset_s: float = 0.0,
    sources: FieldSources | None = None,
) -> JointFit:
    """Return the joint calibration of several sessions of one magnetometer, by the names given.

    The reference is taken ``time_offset_s`` after the telemetry's clock, where an orbit gives it. Of the options,
    ``method`` (scalar or vector), field, orbit, regressors by name and ``robust`` are used.

    Raises
    ------
    InputError, EstimationError
        As `calibrate` and `joint_fit` raise them.
    """
    chosen = CalibrationOptions() if options is None else options
    if isinstance(chosen.regressors, str):
        raise OptionError("regressors: a joint calibration takes them by name")
    if any(map(is_of_scale, chosen.regressors)):
        raise OptionError("regressors: a joint calibration takes those of the bias, not those of the scale")
    is_vector = is_vector_method(chosen.method)
    observed, begun, surrounded = [], [], []
    for samples in sessions.values():
        referenced = Referenced.of(rows_asked_for(samples, chosen), orbits, chosen, sources)
        usable = referenced.usable(chosen.regressors, is_vector)
        known_clock = bool(time_offset_s) and referenced.has_orbit
        surrounded.append(SurroundedSession.of(referenced, usable, chosen, is_vector, is_clock_known=known_clock))
        begun.append(referenced.samples.t_utc[usable].min() if TIME_REGRESSOR not in samples.housekeeping else None)
        if known_clock:
            shift_s = np.full(int(np.count_nonzero(usable)), time_offset_s)
            observed.append(referenced.shifted(usable, chosen.regressors, shift_s))
        else:
            observed.append(referenced.observations(usable, chosen.regressors))
    begin = min((one for one in begun if one is not None), default=None)
    if begin is not None and TIME_REGRESSOR in chosen.regressors:
        observed = [_since_begin(o, one, begin) for o, one in zip(observed, begun, strict=True)]
    robust = _shared_loss(observed, chosen.robust, is_vector=is_vector)
    fit = joint_fit(observed, list(sessions), shared=shared, is_vector=is_vector, robust=robust, surrounded=surrounded)
    return fit if TIME_REGRESSOR not in chosen.regressors else fit.with_time_base(begin)


def _since_begin(o: Observations, own: np.datetime64 | None, begin: np.datetime64) -> Observations:
    """Return the observations with ``time``, which they count since their ``own`` beginning, counted since ``begin``.

    One time base for all sessions: the bias of each is then that of one and the same instant.
    """
    if own is None:
        return o
    return replace(
        o, regressors={**o.regressors, TIME_REGRESSOR: o.regressors[TIME_REGRESSOR] + hours_since(own, begin)}
    )


def _shared_loss(observed: Sequence[Observations], asked: str, *, is_vector: bool) -> str:
    """Return the loss for all sessions: of ``auto`` none where every session is clean, else Tukey's."""
    if asked != AUTO:
        return asked
    estimator = ESTIMATORS["vector" if is_vector else "scalar"]
    settings = FitSettings(AUTO)
    for session in observed:
        # A session too short to be calibrated alone shows no bad rows alone.
        with suppress(EstimationError):
            if not fit_under_loss(estimator, session, settings).is_clean:
                return AUTO_LOSS
    return "none"


def monitor(
    samples: Samples,
    orbits: Sequence[Orbit],
    record: Mapping[str, object],
    *,
    max_orbit_age_days: float = 14.0,
    sources: FieldSources | None = None,
) -> SessionJudgement:
    """Return what a new session says of the active parameter set, whose ``record`` is given; nothing is refitted.

    The field model and the clock's offset are those of the record; ``sources`` have the index and the coefficients that
    the model needs.

    Raises
    ------
    InputError
        The record is no parameter set, or the samples have no reference.
    """
    active = ActiveSet.from_record(record)
    offset_s = active.parameters.time_offset_s or 0.0
    field = field_of_record(record, sources)
    filled, report = with_reference(
        in_time_order(samples), orbits, field, time_offset_s=offset_s, max_orbit_age_days=max_orbit_age_days
    )
    filled, averaging = averaged_as_in(record, active.parameters, filled)
    usable = filled.is_used & np.isfinite(_reference_of(filled, is_vector=active.is_vector))
    usable &= has_columns(filled, tuple(active.parameters.regressors))
    active = _since(active, filled, usable)
    columns = list(active.parameters.regressors)
    observations = Observations.of(oriented(filled, usable), columns, usable.astype(np.float64))
    external = ExternalKnowledge.of(field, FieldSources() if sources is None else sources)
    session = LockedSession(Referenced(filled, report, orbits, field, external, averaging), usable, active.is_vector)
    is_asked = _option(record, "locked_terms", "auto") == "auto"
    is_clock_known = active.parameters.time_offset_s is not None
    return judge_session(observations, active, SurroundedSession(session, is_asked, is_clock_known))


def field_of_record(record: Mapping[str, object], sources: FieldSources | None = None) -> FieldModel:
    """Return the field model of a parameter set: its name, and what it did where the index had no value.

    Raises
    ------
    IndexMissingError, OptionError
        ``sources`` lack the index or the file that it needs.
    """
    gap = _option(record, "index_gap", "refuse")
    return field_model(str(record.get("field_model", "igrf")), index_gap=str(gap), sources=sources)


def averaged_as_in(
    record: Mapping[str, object], parameters: Parameters, samples: Samples, rate: BodyRate | None = None
) -> tuple[Samples, Averaging | None]:
    """Return ``samples``, in time order with their reference, as the sensor of a parameter set averages it, and how.

    ``record``, ``parameters``: those of the set, at the rate of whose source; ``rate``: how the base frame turns, where
    more attitudes than those of ``samples`` tell it.
    """
    integration_s = _option(record, "integration_s", None)
    if not isinstance(integration_s, (int, float)) or not integration_s:
        return samples, None
    if (turning := _gyro_rate(record, samples)) is not None:
        averaging = averaging_by_gyros(samples, integration_s, turning, parameters)
        return averaging.applied(samples), averaging
    if rate is None:
        rate = BodyRate.of_attitude(samples.t_utc, samples.q_base_gcrf)
    averaging = Averaging.of_components(integration_s, rate, samples.b_ref_base_nt)
    return averaging.applied(samples), averaging


def _gyro_rate(record: Mapping[str, object], samples: Samples) -> BodyRate | None:
    """Return how the base frame turns by the gyros that told it to a parameter set; None where none did."""
    said, gyro, columns = record.get("averaging"), record.get("gyro"), _option(record, "gyro", None)
    if not isinstance(said, Mapping) or said.get("rate_from") != GYROS or not isinstance(gyro, Mapping):
        return None
    if not isinstance(columns, (list, tuple)) or not set(columns) <= set(samples.housekeeping):
        return None
    rotation, bias_deg_s = (np.asarray(gyro[name], np.float64) for name in ("rotation", "bias_deg_s"))
    return rate_by_gyros(samples, columns, str(_option(record, "gyro_unit", "deg/s")), rotation, bias_deg_s)


def _option(record: Mapping[str, object], name: str, default: str | None) -> object:
    """Return an option of the job that a parameter set is of."""
    provenance = record.get("provenance")
    options = provenance.get("options") if isinstance(provenance, Mapping) else None
    return options.get(name, default) if isinstance(options, Mapping) else default


def _since(active: ActiveSet, samples: Samples, usable: NDArray[np.bool_]) -> ActiveSet:
    """Return the set with ``time`` counted as the observations of the ``usable`` samples count it: since the first.

    Raises
    ------
    OptionError
        The set drifts with time and does not say since when.
    """
    parameters = active.parameters
    if not parameters.follows_time or TIME_REGRESSOR in samples.housekeeping or not usable.any():
        return active
    if parameters.time_base_utc is None:
        raise OptionError(NO_TIME_BASE)
    return active.at_time_base(samples.t_utc[usable][0])


def _reference_of(samples: Samples, *, is_vector: bool) -> np.typing.NDArray[np.float64]:
    """Return a figure of each sample's reference that is finite where the method can use it, shape (n,)."""
    if is_vector and samples.b_ref_base_nt is not None:
        return np.asarray(samples.b_ref_base_nt.sum(axis=1))
    return np.ones(len(samples)) if samples.b_ref_magnitude_nt is None else samples.b_ref_magnitude_nt


def compare_sensors(
    first: tuple[Samples, Parameters], second: tuple[Samples, Parameters], *, distance_m: float | None = None
) -> Comparison:
    """Return how two magnetometers of one satellite differ once each is corrected with its own parameters.

    Raises
    ------
    TooFewSamplesError
        Too few readings at common times.
    OptionError
        A regressor of the parameters is no column of its samples.
    """
    return compare_magnetometers(_corrected(*first), _corrected(*second), distance_m=distance_m)


def _corrected(samples: Samples, parameters: Parameters) -> CorrectedReadings:
    ordered = in_time_order(samples)
    used = ordered.take(ordered.is_used)
    timed = with_time(used.housekeeping, used.t_utc, parameters.time_base_utc)
    keeping = with_steps(parameters.regressors, timed, used.t_utc)
    missing = missing_columns(parameters.regressors, keeping)
    if missing:
        raise OptionError(f"no housekeeping column {missing[0]!r}, which the parameters need")
    n = len(used)
    t_s = (used.t_utc - used.t_utc[0]) / np.timedelta64(1, "ns") * 1e-9 if n else np.zeros(0)
    columns = {name: regressor_of(name, keeping, used.h_nt, t_s) for name in parameters.regressors}
    plain = Observations(np.zeros(n), used.h_nt, np.ones(n), None, np.ones(n), columns)
    return CorrectedReadings(used.t_utc, corrected_nt(plain, parameters))

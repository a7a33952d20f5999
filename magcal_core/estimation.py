"""The estimate of one session: which regressors, which clock, then the fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.scale_terms import WithScaleTerms
from magcal_core.calibration.terms.clock import AUTO_AGE_DAYS, ClockFit, fit_with_clock
from magcal_core.calibration.terms.regressor_selection import Ablation, ablation_of, choose_regressors, usable_columns
from magcal_core.errors import OptionError
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.regressors import TIME_REGRESSOR


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """The fit and what it was made of; ``clock`` where its offset is part of the result."""

    estimator: Estimator
    options: CalibrationOptions
    settings: FitSettings
    usable: NDArray[np.bool_]
    observations: Observations
    fit: Fit
    clock: ClockFit | None
    tried_clock: ClockFit | None
    ablation: tuple[Ablation, ...]


def _estimate(referenced: Referenced, options: CalibrationOptions) -> _Estimate:
    """Return the estimate with the regressors and the clock that the options ask for or the data support."""
    estimator: Estimator = WithScaleTerms(ESTIMATORS[options.method])
    settings = FitSettings(options.robust, options.noise_model, options.noise_nt)
    names = () if isinstance(options.regressors, str) else options.regressors
    if names and not estimator.takes_regressors:
        raise OptionError(f"{estimator.name} takes no regressors; scalar and vector do")
    usable = referenced.usable(names, estimator.is_vector)
    observations = referenced.observations(usable, names)
    tried = _clock(referenced, estimator, options, settings, usable, observations)
    clock = _taken(tried, options)
    ablation: tuple[Ablation, ...] = ()
    if options.regressors == "auto" and estimator.takes_regressors:
        at = observations if clock is None else _still(clock.observations)
        choice = choose_regressors(estimator, _with_all_columns(referenced, usable, at), settings)
        names, ablation = choice.names, choice.ablation
        usable = referenced.usable(names, estimator.is_vector)
        observations = referenced.observations(usable, names)
        if tried is not None and names:
            # What moves the bias may pass for an offset of the clock, or hide one: the test is made anew beside it.
            tried = _clock(referenced, estimator, options, settings, usable, observations)
            clock = _taken(tried, options)
    elif names:
        at = observations if clock is None else _still(clock.observations)
        ablation = ablation_of(estimator, at, settings, [(), names])
    if clock is None:
        fit = estimator.fit(observations, settings)
    else:
        observations = clock.observations
        fit = clock.fit if estimator.takes_regressors else _at_clock(estimator, observations, settings, clock)
    fit = _since(fit, referenced.samples, usable)
    return _Estimate(estimator, options, settings, usable, observations, fit, clock, tried, ablation)


def _still(observations: Observations) -> Observations:
    """Return the observations with their clock fixed where it is."""
    return replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)


def _with_all_columns(referenced: Referenced, usable: NDArray[np.bool_], observations: Observations) -> Observations:
    """Return the observations with every housekeeping column that may be a regressor."""
    keeping = referenced.samples.housekeeping
    names = usable_columns(keeping, usable)
    columns = {name: np.asarray(keeping[name], np.float64)[usable] for name in names}
    is_complete = np.all([np.isfinite(column) for column in columns.values()], axis=0) if columns else slice(None)
    return replace(observations, regressors=columns).take(is_complete)


def _clock(  # noqa: PLR0917
    referenced: Referenced,
    estimator: Estimator,
    options: CalibrationOptions,
    settings: FitSettings,
    usable: NDArray[np.bool_],
    observations: Observations,
) -> ClockFit | None:
    """Return the fit with a clock where one is asked for, or where the orbit is old enough to look for one."""
    if options.time_offset == "estimate" and not referenced.has_orbit:
        raise OptionError(
            "time_offset: the reference comes with the telemetry, there is no orbit whose clock can differ"
        )
    is_wanted = options.time_offset == "estimate" or (
        options.time_offset == "auto" and referenced.has_orbit and referenced.age_days > AUTO_AGE_DAYS
    )
    if not is_wanted:
        return None
    guide = estimator if estimator.takes_regressors else ESTIMATORS["vector" if estimator.is_vector else "scalar"]
    at = referenced.movable(usable, tuple(observations.regressors)).at
    return fit_with_clock(guide, at, observations, settings, has_drift=options.time_drift)


def _at_clock(estimator: Estimator, observations: Observations, settings: FitSettings, clock: ClockFit) -> Fit:
    """Return the fit of a method that has no clock of its own, at the offset that its sister method found.

    Both end at the same minimum, or within noise of it: the errors are those of the sister, which know of the clock.
    """
    fit = estimator.fit(_still(observations), settings)
    parameters = replace(fit.parameters, time_offset_s=clock.offset_s)
    return replace(
        fit, parameters=parameters, covariance=clock.fit.covariance, blocks=clock.fit.blocks, clock=clock.fit.clock
    )


def _since(fit: Fit, samples: Samples, usable: NDArray[np.bool_]) -> Fit:
    """Return the fit with the instant since which ``time`` counts its hours: the first of the ``usable`` samples."""
    if not fit.parameters.follows_time or TIME_REGRESSOR in samples.housekeeping:
        return fit
    return replace(fit, parameters=replace(fit.parameters, time_base_utc=samples.t_utc[usable][0]))


def _taken(tried: ClockFit | None, options: CalibrationOptions) -> ClockFit | None:
    """Return the clock that is part of the result: one that was asked for, or that the data show."""
    return tried if tried is not None and (options.time_offset == "estimate" or tried.is_significant) else None

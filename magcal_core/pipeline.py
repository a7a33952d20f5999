"""The one way from telemetry to a result: it reads like the order of work, one module a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Unpack

from magcal_core.arrays import Progress
from magcal_core.bias_in_session import Session, wants_moments, with_moving_bias
from magcal_core.calibration.result import Calibration
from magcal_core.errors import EstimationError, FrameError, UnitsError
from magcal_core.estimation.averaging import averaged_by_gyros
from magcal_core.estimation.clock import with_clock
from magcal_core.estimation.diagnosis import diagnosed, refused, with_cause
from magcal_core.estimation.estimate import Estimate, Prepared
from magcal_core.estimation.judgement import judged
from magcal_core.estimation.noise import with_noise
from magcal_core.estimation.odd_light import without_odd_light
from magcal_core.estimation.record import calibration_of
from magcal_core.estimation.regressor_choice import with_regressors
from magcal_core.estimation.start_and_loss import started
from magcal_core.estimation.time_base import with_time_base
from magcal_core.estimation.trust import with_locked_terms
from magcal_core.field.sources import FieldFile, FieldSources, GivenIndices
from magcal_core.options import CalibrationOptions, OptionValues
from magcal_core.orbit import Orbit
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.reference.rows_asked_for import rows_asked_for, warnings_of_rows
from magcal_core.samples import Samples

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.monitoring import ActiveSet

__all__ = ["CalibrationOptions", "calibrate"]


def calibrate(
    samples: Samples,
    orbits: Sequence[Orbit] = (),
    options: CalibrationOptions | None = None,
    *,
    index: GivenIndices = None,
    field_file: FieldFile = None,
    active: ActiveSet | None = None,
    candidates: Sequence[Orbit] = (),
    with_moments: bool = False,
    progress: Progress | None = None,
    **overrides: Unpack[OptionValues],
) -> Calibration:
    """Return the calibration of one magnetometer from its telemetry.

    Parameters
    ----------
    samples : Samples
        Telemetry, in any order.
    orbits : sequence of Orbit
        Where the satellite was; not needed where the telemetry brings a reference field or a position.
    options : CalibrationOptions
        How to calibrate; ``overrides`` replace single ones, by the names of `CalibrationOptions`.
    index : Index, path, bytes, open file, or several of them
        Indices of the external field, of which the later holds: what ``field`` needs, and what tells of a storm.
    field_file : CoefficientFile, path, bytes or open file
        Coefficients, where ``field`` has ``file``.
    active : ActiveSet
        The calibration that is in force; the verdict tells where the new one differs.
    candidates : sequence of Orbit
        Orbits of other objects that the telemetry may be of: a diagnosis tries them, nothing else does.
    with_moments : bool
        Whether the result keeps the moments of the fit, from which it can be made again without the samples.
    progress : callable
        Is called with the share of the work that is done, from 0 to 1.

    Raises
    ------
    InputError
        The samples, the orbits or the options cannot be used; the subclass says why.
    NotObservableError, TooFewSamplesError
        The samples do not determine the parameters; `WrongInputError` where the cause has a name. ``diagnosis`` of the
        error has the causes, ``data_quality`` what the rows are worth.
    """
    chosen = CalibrationOptions() if options is None else options
    if overrides:
        chosen = CalibrationOptions.from_dict(chosen.to_dict() | dict(overrides))
    tell = progress if progress is not None else lambda _share: None
    tell(0.0)
    sources = FieldSources.of(index, field_file)
    asked_for = rows_asked_for(samples, chosen)
    referenced = Referenced.of(asked_for, orbits, chosen, sources)
    tell(0.2)
    try:
        estimate = _estimate(referenced, chosen)
        if (turning := averaged_by_gyros(estimate)) is not None:
            estimate = _estimate(turning, chosen)
        tell(0.6)
        judgement = judged(estimate, active)
    except (EstimationError, FrameError, UnitsError) as error:
        raise refused(error, referenced, candidates) from error
    tell(0.9)
    diagnosis = diagnosed(estimate, judgement, candidates)
    tell(0.95)
    needs_moments = with_moments or wants_moments(chosen)
    judgement = with_cause(judgement, diagnosis)
    calibration = calibration_of(estimate, judgement, diagnosis, with_moments=needs_moments, for_refits=with_moments)
    moments = calibration.moments
    if not with_moments:
        calibration = replace(calibration, moments=None)

    def again(part: Samples, options: CalibrationOptions) -> Calibration:
        return calibrate(
            part,
            orbits,
            replace(options, without=(), time_scale="utc"),
            index=sources.indices,
            field_file=sources.file,
            active=active,
            candidates=candidates,
            with_moments=with_moments,
        )

    calibration = with_moving_bias(calibration, moments, Session(asked_for, orbits, chosen), again)
    told = tuple(warnings_of_rows(samples, asked_for, chosen))
    if told:
        calibration = replace(calibration, warnings=(*told, *calibration.warnings))
    tell(1.0)
    return calibration


def _estimate(referenced: Referenced, options: CalibrationOptions) -> Estimate:
    """Return the estimate: start and loss, clock, noise model, regressors, and what locked errors leave of it."""
    fitted = without_odd_light(with_regressors(with_noise(with_clock(started(Prepared.of(referenced, options))))))
    return with_time_base(with_locked_terms(fitted))

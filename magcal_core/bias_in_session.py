"""What a calibration does about a bias that moves inside its session: steps named or fitted, windows of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from magcal_core.calibration.estimators.registry import step_methods
from magcal_core.calibration.observability.information import WEAK_BELOW, Observability
from magcal_core.calibration.reasons import Reason, Verdict
from magcal_core.calibration.refit.moments import FitMoments
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.terms.bias_steps import NOT_SEARCHED, BiasSteps, bias_steps
from magcal_core.calibration.terms.locked import CERTAIN
from magcal_core.calibration.terms.locked_posterior import DRIFT
from magcal_core.errors import OptionError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.messages.elements import elements_from_state
from magcal_core.reference.referenced_samples import in_time_order
from magcal_core.samples import SampleFlag, Samples

Again = Callable[[Samples, CalibrationOptions], Calibration]


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """What a calibration was made of: samples, in any order, orbits and options."""

    samples: Samples
    orbits: Sequence[Orbit]
    options: CalibrationOptions


def wants_moments(options: CalibrationOptions) -> bool:
    """Return whether steps are to be looked for; a method that cannot fit them is refused where that is asked.

    Raises
    ------
    OptionError
        ``bias_steps`` is ``fit`` and the method takes no regressors or leaves no moments.
    """
    if options.bias_steps == "fit" and options.method not in step_methods():
        raise OptionError(f"bias_steps: {options.method} cannot fit steps; {' and '.join(step_methods())} can")
    return options.bias_steps != "none"


def with_moving_bias(
    calibration: Calibration, moments: FitMoments | None, session: Session, again: Again
) -> Calibration:
    """Return the calibration with the steps of the bias, named or fitted, and its windows, as its options ask.

    ``moments``: of its fit, None where there are none; ``again``: calibrates other samples with other options.

    Raises
    ------
    OptionError, TooFewSetsError
        There are fewer than three windows, or fewer can be calibrated.
    """
    options = session.options
    if options.bias_steps != "none":
        # Moments are of nine parameters: what twelve explain beside them would look like steps.
        of_nine = None if calibration.has_full_matrix else moments
        steps = steps_of_session(of_nine, calibration.observability, has_drift=_drifts(calibration))
        if options.bias_steps == "fit" and steps.items and moments is not None:
            fitted = again(*_with_steps_fitted(session, moments, steps))
            calibration, steps = replace(fitted, options=options.to_dict()), replace(steps, is_fitted=True)
        calibration = _with_steps_named(calibration, steps)
    if options.windows is not None:
        from magcal_core.calibration.sessions.windows import windows_of

        one_by_one = replace(options, windows=None, bootstrap=0)
        period_s = _period_s(session.orbits, calibration.data_from)
        ordered = in_time_order(session.samples)
        found = windows_of(ordered, options.windows, lambda part: again(part, one_by_one), period_s)
        calibration = replace(calibration, windows=found)
    return calibration


def steps_of_session(moments: FitMoments | None, observability: Observability, *, has_drift: bool = False) -> BiasSteps:
    """Return the steps of the bias that a fit shows; none are looked for where the data hardly determine it.

    The index says so, not the verdict: a step makes the field uncertain, which is no reason not to look for it.
    ``has_drift``: beside a line in time.
    """
    if moments is None or not observability.index >= WEAK_BELOW:
        return NOT_SEARCHED
    return bias_steps(moments, has_drift=has_drift)


def _drifts(calibration: Calibration) -> bool:
    """Return whether a drift of the bias is certain."""
    said = calibration.extras.get("locked_terms")
    families = said.get("families") if isinstance(said, dict) else None
    drift = families.get(DRIFT) if isinstance(families, dict) else None
    return isinstance(drift, dict) and float(drift["probability"]) > CERTAIN


def _with_steps_fitted(session: Session, moments: FitMoments, steps: BiasSteps) -> tuple[Samples, CalibrationOptions]:
    """Return samples and options of the fit that has the steps as unknowns, without the two blocks about each."""
    samples = session.samples
    about = np.zeros(len(samples), bool)
    for step in steps.items:
        begin, end = moments.begins[step.block - 1], moments.ends[step.block]
        about |= (samples.t_utc >= begin) & (samples.t_utc <= end)
    names = tuple(dict.fromkeys((*moments.fitted, *(step.column for step in steps.items))))
    options = replace(session.options, regressors=names, bias_steps="none", windows=None)
    return samples.flagged(SampleFlag.BIAS_STEP, about), options


def _with_steps_named(calibration: Calibration, steps: BiasSteps) -> Calibration:
    """Return the calibration whose record names the steps, and its verdict those that its fit does not have."""
    if steps.is_fitted or not steps.items:
        return replace(calibration, bias_steps=steps)
    return replace(calibration, bias_steps=steps, verdict=_weakened(calibration.verdict, steps))


def _weakened(verdict: Verdict, steps: BiasSteps) -> Verdict:
    """Return the verdict with a reason for each step: at best weak, the reasons of the worse grade first."""
    found = tuple(Reason("bias_step", step.text) for step in steps.items)
    grades = ("weak",) * len(found)
    if verdict.grade == "accept":
        return Verdict("weak", found, grades)
    return Verdict(verdict.grade, (*verdict.reasons, *found), (*verdict.grades, *grades))


def _period_s(orbits: Sequence[Orbit], t_utc: np.datetime64) -> float | None:
    """Return the period of the orbit whose epoch is nearest to ``t_utc``, s; None where there is no orbit."""
    if not orbits:
        return None
    nearest = min(orbits, key=lambda orbit: abs(orbit.epoch_utc - t_utc))
    r_km, v_km_s = nearest.state_gcrf(np.array([nearest.epoch_utc]))
    return elements_from_state(r_km[0], v_km_s[0]).period_s()

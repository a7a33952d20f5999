"""What a calibration does about a bias that steps inside its session: it is named, or fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from magcal_core.calibration import ESTIMATORS
from magcal_core.calibration.moments import METHODS as MOMENTS_METHODS
from magcal_core.calibration.moments import FitMoments
from magcal_core.calibration.result import Calibration, Reason, Verdict
from magcal_core.calibration.terms.bias_steps import NOT_SEARCHED, BiasSteps, bias_steps
from magcal_core.errors import OptionError
from magcal_core.options import CalibrationOptions
from magcal_core.samples import SampleFlag, Samples

_HARDLY_DETERMINED: Final = frozenset({"weakly_observable", "not_observable"})
"""Reasons of a verdict where a step cannot be told from what the field does not show."""


def wants_moments(options: CalibrationOptions) -> bool:
    """Return whether steps are to be looked for; a method that cannot fit them is refused where that is asked.

    Raises
    ------
    OptionError
        ``bias_steps`` is ``fit`` and the method takes no regressors or leaves no moments.
    """
    if options.bias_steps == "fit" and not (
        ESTIMATORS[options.method].takes_regressors and options.method in MOMENTS_METHODS
    ):
        raise OptionError(f"bias_steps: {options.method} cannot fit steps; scalar and vector can")
    return options.bias_steps != "none"


def steps_of_session(moments: FitMoments | None, verdict: Verdict) -> BiasSteps:
    """Return the steps of the bias that a fit shows; none are looked for where the data hardly determine it."""
    if moments is None or any(reason.code in _HARDLY_DETERMINED for reason in verdict.reasons):
        return NOT_SEARCHED
    return bias_steps(moments)


def with_steps_fitted(
    samples: Samples, moments: FitMoments, steps: BiasSteps, options: CalibrationOptions
) -> tuple[Samples, CalibrationOptions]:
    """Return samples and options of the fit that has the steps as unknowns, without the two blocks about each."""
    about = np.zeros(len(samples), bool)
    for step in steps.items:
        begin = moments.begins[step.block - 1]
        end = moments.ends[step.block]
        about |= (samples.t_utc >= begin) & (samples.t_utc <= end)
    columns = [step.column for step in steps.items]
    names = (*moments.fitted, *(column for column in columns if column not in moments.fitted))
    return samples.flagged(SampleFlag.BIAS_STEP, about), replace(
        options, regressors=names, bias_steps="none", windows=None
    )


def with_steps_named(calibration: Calibration, steps: BiasSteps) -> Calibration:
    """Return the calibration whose record and verdict name the steps that its fit does not have."""
    extras = {**calibration.extras, "bias_steps": steps.to_dict()}
    if steps.is_fitted or not steps.items:
        return replace(calibration, extras=extras)
    verdict = _weakened(calibration.verdict, [step.text for step in steps.items])
    return replace(calibration, extras=extras, verdict=verdict)


def _weakened(verdict: Verdict, texts: Sequence[str]) -> Verdict:
    """Return the verdict with a reason for each step: at best weak, the reasons of the worse grade first."""
    found = tuple(Reason("bias_step", text) for text in texts)
    if verdict.grade == "accept":
        return Verdict("weak", found)
    return Verdict(verdict.grade, (*verdict.reasons, *found))

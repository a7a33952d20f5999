"""The verdict: one word on a calibration, with the reasons that led to it.

Every limit is explained, with the rate of wrong verdicts that it was set for, in `docs/calibration.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.reasons import Reason, Verdict
from magcal_core.calibration.residuals import ResidualStatistics
from magcal_core.calibration.uncertainty.field_error import FieldError
from magcal_core.sensor.parameters import Parameters

if TYPE_CHECKING:
    from magcal_core.calibration.verdict.agreement import Agreement


@dataclass(frozen=True, slots=True)
class Limits:
    """From which value on a figure makes a calibration weak, and from which on it is refused."""

    weak: float
    refuse: float


FIELD_ERROR: Final = Limits(0.02, 0.05)
"""Error of the corrected field in its worst direction, at 95 %, as a share of it (`field_error`)."""
DETERMINED: Final = 1.0
"""The same from which on the samples determine nothing: no number is given."""
NOISE_ALONE: Final = 0.7
"""Noise-safe index that samples which determine nothing reach at most."""
MISALIGNED_DEG: Final = Limits(0.6, 3.0)
"""Standard error of the turn that a full matrix has against the sensor's base frame, deg."""
TURNED_DEG: Final = 30.0
"""Turn from which on the attitude or the axis map is another one than was said."""
RESIDUAL: Final = Limits(0.05, 0.20)
"""RMS residual as a share of the mean field."""
UNSEEN: Final = Limits(1.6, 4.0)
"""Cross-validated RMS over the RMS of the fit."""
SCALE_FAR: Final = 2.5
"""Factor between the mean scale factor and 1 from which the readings are hardly in the unit that was said."""
REJECTED: Final = Limits(0.08, 0.50)
"""Share of the rows with a reading that the loss rejected."""
WITHOUT_READING: Final = Limits(0.50, np.inf)
"""Share of the rows that hold no reading: empty, zeros, fill values, stuck, repeated, saturated."""


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn of the reference against the sensor's base frame that a full matrix shows, and its standard error, deg."""

    angle_deg: float
    error_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the verdict is based on; nT where a name has it."""

    index: float
    field_error: FieldError
    parameters: Parameters
    standard_errors: Parameters
    mean_field_nt: float
    field_variation: float
    before: ResidualStatistics
    after: ResidualStatistics
    cross_validated_rms_nt: float | None
    rejected_share: float
    without_reading_share: float
    is_converged: bool
    is_vector: bool
    is_plain: bool
    orbit_age_days: float
    has_time_offset: bool
    suspicions: tuple[str, ...] = ()
    turn: Turn | None = None
    agreement: Agreement | None = None
    storm: str | None = None


def judge(evidence: Evidence) -> Verdict:
    """Return the verdict: ``refuse`` where one reason refuses, else ``weak`` where one weakens, else ``accept``."""
    found = [*_not_finite(evidence), *_field(evidence), *_residuals(evidence), *_circumstances(evidence)]
    grades = {grade for grade, _ in found}
    grade = "refuse" if "refuse" in grades else "weak" if "weak" in grades else "accept"
    if not found:
        share, index = evidence.field_error.share, evidence.index
        text = (
            f"the corrected field is known to {share:.2g} of it in its worst direction; observability index {index:.3g}"
        )
        found = [("accept", Reason("observable", text))]
    order = {"refuse": 0, "weak": 1, "accept": 2}
    found.sort(key=lambda entry: order[entry[0]])
    return Verdict(grade, tuple(reason for _, reason in found), tuple(grade for grade, _ in found))


_Found = list[tuple[str, Reason]]


def _graded(value: float, limits: Limits, code: str, text: str) -> _Found:
    if not np.isfinite(value):
        # A comparison with NaN is false whichever way it is written: a NaN must not pass for a good figure.
        return [("refuse", Reason(code, f"{text}: not a finite number"))]
    if value < limits.weak:
        return []
    refused = value >= limits.refuse
    limit = limits.refuse if refused else limits.weak
    return [("refuse" if refused else "weak", Reason(code, f"{text}, limit {limit:g}"))]


def _not_finite(evidence: Evidence) -> _Found:
    """Refuse where any figure that the verdict is based on is not a finite number; its limits cannot be asked then."""
    agreement, turn = evidence.agreement, evidence.turn
    figures: dict[str, float | Floats | None] = {
        "observability index": evidence.index,
        "error of the field": evidence.field_error.share,
        "parameters": evidence.parameters.vector,
        "standard errors": evidence.standard_errors.vector,
        "mean field": evidence.mean_field_nt,
        "variation of the field": evidence.field_variation,
        "residual before": _figures_of(evidence.before),
        "residual after": _figures_of(evidence.after),
        "residual on unseen data": evidence.cross_validated_rms_nt,
        "share of rejected samples": evidence.rejected_share,
        "age of the orbit": evidence.orbit_age_days,
        "turn of the reference": None if turn is None else np.array([turn.angle_deg, turn.error_deg]),
        "change against the set in force": None
        if agreement is None
        else np.array([agreement.p_value, agreement.field_change_nt, agreement.limit_nt]),
    }
    bad = [name for name, value in figures.items() if value is not None and not np.isfinite(value).all()]
    return [("refuse", Reason("not_finite", f"not a finite number: {', '.join(bad)}"))] if bad else []


def _figures_of(residual: ResidualStatistics) -> Floats:
    return np.array([residual.mean_nt, residual.std_nt, residual.rms_nt])


def _field(evidence: Evidence) -> _Found:
    """Weigh the error of the corrected field; the errors of the parameters stay in the text."""
    errors, found = evidence.standard_errors, evidence.field_error
    bias_nt = float(np.max(errors.bias_nt))
    scale = float(np.max(errors.scale / np.abs(evidence.parameters.scale)))
    angle_deg = float(np.max(errors.nonorthogonality_deg))
    text = (
        f"the corrected field is known to {found.share:.2g} of it in its worst direction, most of it from the "
        f"{found.largest}: bias known to {bias_nt:.0f} nT, scale factor to {scale:.2g}, angle to {angle_deg:.2g} deg"
    )
    if not found.share <= DETERMINED:
        return [("refuse", Reason("not_observable", f"{text}, limit {DETERMINED:g}"))]
    return _graded(found.share, FIELD_ERROR, "field_uncertain", text)


def _residuals(evidence: Evidence) -> _Found:
    after, unseen = evidence.after, evidence.cross_validated_rms_nt
    share = after.rms_nt / evidence.mean_field_nt
    found = _graded(share, RESIDUAL, "large_residual", f"RMS residual {after.rms_nt:.0f} nT, {share:.2g} of the field")
    if unseen is None:
        found.append(
            ("weak", Reason("not_cross_validated", "a part of the data alone does not determine the parameters"))
        )
    else:
        ratio = unseen / max(after.rms_nt, 1e-6 * evidence.mean_field_nt)
        text = f"{unseen:.0f} nT on blocks that the fit has not seen, {after.rms_nt:.0f} nT on its own"
        found += _graded(ratio, UNSEEN, "poor_on_unseen_data", f"{text}: ratio {ratio:.2g}")
        if unseen > evidence.before.rms_nt:
            found.append(("refuse", Reason("worse_than_raw", f"{text}, raw {evidence.before.rms_nt:.0f} nT")))
    # At a minimum sum r |B| = 0 with the corrected |B|, so that |mean r| <= sigma CV(|B|): a larger mean is at none.
    bound = after.std_nt * evidence.field_variation
    if (
        evidence.is_plain
        and not evidence.is_vector
        and abs(after.mean_nt) > bound * 1.01 + 1e-6 * evidence.mean_field_nt
    ):
        text = f"mean residual {after.mean_nt:.3g} nT, at a minimum at most {bound:.3g} nT"
        found.append(("refuse", Reason("not_a_minimum", text)))
    return found


def _circumstances(evidence: Evidence) -> _Found:
    found = _graded(
        evidence.rejected_share,
        REJECTED,
        "many_rejected",
        f"{evidence.rejected_share:.1%} of the readings were rejected by the loss",
    )
    text = f"{evidence.without_reading_share:.1%} of the rows hold no reading"
    found += _graded(evidence.without_reading_share, WITHOUT_READING, "rows_without_reading", text)
    if evidence.turn is not None:
        found += _turned(evidence.turn)
    if not evidence.is_converged:
        found.append(("refuse", Reason("not_converged", "the search for the minimum did not end")))
    if evidence.orbit_age_days > 3.0 and not evidence.has_time_offset:
        text = f"the orbit is {evidence.orbit_age_days:.1f} d from the data and its time offset was not looked for"
        found.append(("weak" if evidence.orbit_age_days <= 14.0 else "refuse", Reason("orbit_old", text)))
    found += _scale_far(evidence)
    if evidence.agreement is not None and evidence.agreement.is_material:
        found.append(("weak", Reason("differs_from_active", evidence.agreement.text)))
    if evidence.storm is not None:
        found.append(("weak", Reason("storm", evidence.storm)))
    found += [("refuse", Reason("wrong_input_suspected", text)) for text in evidence.suspicions]
    return found


def _turned(turn: Turn) -> _Found:
    """Weigh a turn that the full matrix shows: one that is known well is a warning of the fit, no reason."""
    text = f"the reference is turned by {turn.angle_deg:.3g} +- {turn.error_deg:.2g} deg from the sensor's frame"
    if turn.angle_deg > TURNED_DEG:
        return [("refuse", Reason("frame", f"{text}: mend the axis map or the attitude, limit {TURNED_DEG:g} deg"))]
    return _graded(turn.error_deg, MISALIGNED_DEG, "misaligned", f"{text}, known to {turn.error_deg:.2g} deg")


def _scale_far(evidence: Evidence) -> _Found:
    """Weaken where the readings are a multiple of the field that no unit explains: raw counts, or a gain unknown."""
    mean = float(np.exp(np.mean(np.log(np.maximum(np.abs(evidence.parameters.scale), 1e-300)))))
    if evidence.suspicions or 1.0 / SCALE_FAR <= mean <= SCALE_FAR:
        return []
    text = (
        f"the readings are {mean:.3g} times the field, more than a factor {SCALE_FAR:g} off: raw counts, another unit?"
    )
    return [("weak", Reason("scale_far", text))]

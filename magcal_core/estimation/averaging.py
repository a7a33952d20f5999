"""A sensor that averages: its reference by gyros once these lie somewhere, and what the record says of all of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.residual_warnings import SHIFT
from magcal_core.estimation.estimate import Estimate
from magcal_core.estimation.gyros import gyros_of, sent_rates
from magcal_core.numerics.vectors import lengths
from magcal_core.observations import corrected_nt
from magcal_core.reference.averaging import GYROS, MAX_STEP_S, Averaging, BodyRate, across_share
from magcal_core.reference.error_budget import BudgetItem
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.parameters import Parameters

_MAX_TURN_RAD: Final = np.pi / 3.0
"""Largest turn of the field between two readings that tells how fast it turns in the sensor."""
LONGEST_INTEGRATION_S: Final = 60.0
"""Longest time that a reading may take, s: what options let through."""
ENOUGH: Final = 5000
"""Steps that are looked at, evenly spaced."""
_MOST_STEPS: Final = 0.5
"""Part of the steps between readings that must tell it."""


def averaged_by_gyros(estimate: Estimate) -> Referenced | None:
    """Return the reference over the sensor's integration time, at the rate that gyros tell.

    None where the sensor does not average, attitudes tell the rate, no gyros are named, or how they lie is not known:
    ``estimate`` is that without averaging, which tells it.

    Raises
    ------
    OptionError
        What `gyros_of` raises.
    """
    options, referenced = estimate.options, estimate.prepared.referenced
    if referenced.averaging is None or referenced.averaging.is_known.any() or not options.gyro:
        return None
    found, samples = gyros_of(estimate), referenced.samples
    if found is None or found.rotation is None or found.bias_deg_s is None:
        return None
    rate = rate_by_gyros(samples, options.gyro, options.gyro_unit, found.rotation, found.bias_deg_s)
    averaging = averaging_by_gyros(samples, referenced.averaging.integration_s, rate, estimate.fit.parameters)
    return replace(referenced, samples=averaging.applied(samples), averaging=averaging)


def rate_by_gyros(
    samples: Samples, columns: Sequence[str], unit: str, rotation: Floats, bias_deg_s: Floats
) -> BodyRate:
    """Return how the base frame turns by the gyros in ``columns``.

    ``rotation``: from gyro axes to the base frame, shape (3, 3); ``bias_deg_s``: theirs, shape (3,), deg/s.
    """
    rate = sent_rates(samples, columns, unit) - np.deg2rad(bias_deg_s)
    return BodyRate(GYROS, rate @ rotation.T, np.zeros_like(rate))


def averaging_by_gyros(samples: Samples, integration_s: float, rate: BodyRate, parameters: Parameters) -> Averaging:
    """Return what averaging makes of the reference of ``samples``, where need be by the direction of their readings."""
    by_components = Averaging.of_components(integration_s, rate, samples.b_ref_base_nt)
    if samples.b_ref_magnitude_nt is None:
        return by_components
    # Regressors are left out: what they turn the reading by is nothing to the share.
    x_nt = (samples.h_nt - parameters.bias_nt) @ parameters.correction_matrix.T
    by_readings = Averaging.of_readings(integration_s, rate, x_nt, samples.b_ref_magnitude_nt)
    share = np.where(by_components.is_known, by_components.share, by_readings.share)
    return replace(by_components, share=share)


@dataclass(frozen=True, slots=True)
class AveragingReport:
    """What the record says of a sensor that averages.

    Attributes
    ----------
    integration_s : s, about the time stamp.
    rate_from : ``quaternions`` or ``gyros`` where one of them told the rate, else None.
    samples, known : how many samples the fit has, and of how many the reference is averaged.
    rate_deg_s : their median rate, deg/s.
    loss_share : root mean square of what averaging takes of |B|, of 1, where it is known.
    unknown_share : the same, at most, of the samples whose rate is not known; None where nothing bounds it.
    unknown_nt : that, nT.
    why : in words.
    """

    integration_s: float
    rate_from: str | None
    samples: int
    known: int
    rate_deg_s: float | None
    loss_share: float | None
    unknown_share: float | None
    unknown_nt: float | None
    why: str

    def to_dict(self) -> dict[str, object]:
        """Return the report as the records of the service have it."""
        return {
            "integration_s": self.integration_s,
            "stamp": "middle",
            "is_used": self.known > 0,
            "rate_from": self.rate_from,
            "samples": self.known,
            "rate_deg_s": self.rate_deg_s,
            "loss_share": self.loss_share,
            "unknown_share": self.unknown_share,
            "why": self.why,
        }

    @property
    def budget_item(self) -> BudgetItem | None:
        """What is not allowed for; None where every sample's reference is averaged."""
        if self.known == self.samples:
            return None
        return BudgetItem("sensor_averaging", self.unknown_nt, self.why)

    def warnings(self, scale: Floats, scale_errors: Floats) -> Iterator[str]:
        """Yield the warning of averaging that is not allowed for, where it may move a scale factor."""
        if self.known == self.samples:
            return
        least = float(np.min(scale_errors / np.abs(scale)))
        if self.unknown_share is None or self.unknown_share > SHIFT * least:
            yield f"averaging_not_used: {self.why}"


def said_of_averaging(estimate: Estimate) -> AveragingReport | None:
    """Return what is said of the sensor's averaging; None where it does not average."""
    averaging = estimate.prepared.referenced.averaging
    if averaging is None:
        return None
    own = averaging.take(estimate.usable)
    n, known = len(own.share), int(np.count_nonzero(own.is_known))
    rate_deg_s = loss = unknown_share = unknown_nt = None
    source = own.rate.source if known else None
    if known:
        rate_deg_s = float(np.rad2deg(np.median(lengths(own.rate.rate_rad_s[own.is_known]))))
        loss = _rms(1.0 - own.share[own.is_known])
        why = f"the reference is averaged at the rate that {source} tell"
    if known < n:
        unknown_share, by = _bound(estimate, own)
        unknown_nt = None if unknown_share is None else unknown_share * _rms(estimate.observations.b_nt)
        of = f"of {n - known} of {n} samples" if known else "of the samples"
        told = (
            f"{by}, it takes {unknown_share:.2g} of |B|"
            if unknown_share is not None
            else f"{by} to bound what it takes"
        )
        why = (
            f"the rate {of} is not known ({_why_not(estimate, own)}), and their reference is not averaged over "
            f"{own.integration_s:g} s; {told}; a steady turn makes scale factors smaller and leaves no residual"
        )
    return AveragingReport(own.integration_s, source, n, known, rate_deg_s, loss, unknown_share, unknown_nt, why)


def _why_not(estimate: Estimate, averaging: Averaging) -> str:
    """Return why a rate is not known."""
    samples = estimate.prepared.referenced.samples
    if averaging.rate.is_known.any() and samples.b_ref_base_nt is None:
        return "the field's direction in the base frame neither"
    if estimate.options.gyro:
        return "neither attitudes near each other nor gyros whose mounting is resolved"
    if samples.q_base_gcrf is None:
        return "no attitude, and no gyros are named"
    return f"attitudes more than {MAX_STEP_S:g} s or a quarter turn apart, and no gyros are named"


def _bound(estimate: Estimate, averaging: Averaging) -> tuple[float | None, str]:
    """Return what averaging may take of |B| at the samples, of 1, and what tells: gyros at most, else the readings."""
    options, samples = estimate.options, estimate.prepared.referenced.samples
    if options.gyro:
        speed = lengths(sent_rates(samples, options.gyro, options.gyro_unit)[estimate.usable])
        speed = speed[np.isfinite(speed)]
        if len(speed):
            largest = float(np.max(1.0 - across_share(speed, averaging.integration_s)))
            return largest, "at most, by the gyros' largest rate"
    speed_rad_s = _turn_of_readings(estimate, MAX_STEP_S)[0]
    if not len(speed_rad_s):
        return None, "the readings are too far apart"
    return _rms(1.0 - across_share(speed_rad_s, averaging.integration_s)), "by the turn of the readings"


def _turn_of_readings(estimate: Estimate, longest_s: float) -> tuple[Floats, Floats]:
    """Return how fast the field turns in the sensor from reading to reading, rad/s, and their steps, s, shape (m,).

    Of steps of at most ``longest_s`` that tell it, some `ENOUGH` of them; of none where these are not most.
    """
    observations = estimate.observations
    first = np.arange(0, len(observations) - 1, max(1, len(observations) // ENOUGH))
    step_s = observations.t_s[first + 1] - observations.t_s[first]
    here, there = (corrected_nt(observations.take(rows), estimate.fit.parameters) for rows in (first, first + 1))
    turn_rad = np.arctan2(lengths(np.cross(here, there)), np.sum(here * there, axis=1))
    is_near = (step_s > 0.0) & (step_s <= longest_s)
    is_told = is_near & (turn_rad <= _MAX_TURN_RAD)
    if not np.count_nonzero(is_told) > _MOST_STEPS * len(step_s):
        return np.zeros(0), np.zeros(0)
    return turn_rad[is_told] / step_s[is_told], step_s[is_told]


def untold_averaging(estimate: Estimate, scale_errors: Floats) -> str | None:
    """Return the warning of averaging that may be there: nobody said how long a reading takes, and it would matter.

    Where a sensor that averages from one reading to the next would miss a scale factor by half its standard error,
    ``scale_errors``, shape (3,). None where an ``integration_s`` is given, zero included, or the turn is not known.
    """
    if estimate.options.integration_s is not None:
        return None
    speed_rad_s, steps_s = _turn_of_readings(estimate, LONGEST_INTEGRATION_S)
    if not len(speed_rad_s):
        return None
    step_s = float(np.median(steps_s))
    share = _rms(1.0 - across_share(speed_rad_s, step_s))
    if share <= SHIFT * float(np.min(scale_errors / np.abs(estimate.fit.parameters.scale))):
        return None
    turn_deg = float(np.rad2deg(_rms(speed_rad_s * step_s)))
    return (
        f"averaging_not_known: the field turns by {turn_deg:.2g} deg in the sensor from one reading to the next; one "
        f"that averages over these {step_s:g} s reads up to {share:.2g} of it too little, scale factors come out as "
        "much too small, and no residual shows it: give integration_s, 0 where readings are momentary"
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))

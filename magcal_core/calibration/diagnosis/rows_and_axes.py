"""Causes that rows and axes show by themselves: a constant sensor, a constant axis, a wrong unit, bad rows."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.cause import Finding
from magcal_core.calibration.diagnosis.explanation import spread_of
from magcal_core.observations import ratio_beyond
from magcal_core.samples import SampleFlag, Samples
from magcal_core.units import NT_PER_UNIT

STILL_SHARE: Final = 0.02
"""Spread of an axis, as a share of |B|, below which it is constant."""
MOVING_SHARE: Final = 0.10
STUCK_SHARE: Final = 0.5
EQUAL_STEPS: Final = (0.9, 0.5)
"""Share of equal steps from which an axis is stuck, where the median axis has fewer than the second figure."""
UNIT_RATIO: Final = 8.0
BAD_SHARE: Final = 0.02
SHORT_S: Final = 900.0
"""Time within which a satellite that does not turn may read a nearly constant field."""
_STUCK: Final = SampleFlag.STUCK | SampleFlag.ZERO | SampleFlag.REPEATED
_SCREENED: Final = _STUCK | SampleFlag.FILL_VALUE | SampleFlag.SATURATED | SampleFlag.NOT_FINITE


def constant_sensor(samples: Samples, h_nt: Floats, b_nt: Floats, duration_s: float) -> Finding | None:
    """Return that the whole sensor is constant: most rows stuck, or no axis that moves; None where it is not."""
    stuck = float(np.mean((samples.flags & np.uint16(_STUCK)) != 0))
    if stuck >= STUCK_SHARE:
        text = f"the sensor is constant: {stuck:.0%} of the rows are stuck, zero or repeated; is it on and read out?"
        return Finding("sensor_constant", text, stuck, "share", stuck / STUCK_SHARE)
    if not len(h_nt):
        return None
    field_nt = float(np.median(b_nt))
    size_nt = float(np.median(np.linalg.norm(h_nt, axis=1)))
    # Readings in another unit are small beside the field and vary all the same: their own size is the measure.
    measure_nt = size_nt if 0.0 < size_nt < field_nt / UNIT_RATIO else field_nt
    share = max(spread_of(column) for column in h_nt.T) / measure_nt
    # In a short pass without motion any sensor is constant: that is a matter of motion.
    if share >= STILL_SHARE or (duration_s < SHORT_S and spread_of(b_nt) < STILL_SHARE * field_nt):
        return None
    text = f"the sensor is constant: no axis varies by more than {share:.2g} of the field; is it on and read out?"
    return Finding("sensor_constant", text, share, "share of the field", STILL_SHARE / max(share, 1e-9))


def constant_axis(h_nt: Floats, b_nt: Floats) -> Finding | None:
    """Return the axis that is constant, or stuck, while others move; None where there is none."""
    if len(h_nt) < 3:
        return None
    field_nt = float(np.median(b_nt))
    spreads = np.array([spread_of(column) for column in h_nt.T]) / field_nt
    axis = int(np.argmin(spreads))
    if spreads[axis] < STILL_SHARE and np.sort(spreads)[1] > MOVING_SHARE:
        text = f"axis {axis + 1} is constant: it varies by {spreads[axis]:.2g} of the field, the others by "
        text += " and ".join(f"{one:.2g}" for i, one in enumerate(spreads) if i != axis)
        return Finding(
            "axis_constant", text, float(spreads[axis]), "share of the field", STILL_SHARE / max(spreads[axis], 1e-9)
        )
    equal = np.mean(np.diff(h_nt, axis=0) == 0.0, axis=0)
    axis = int(np.argmax(equal))
    if equal[axis] >= EQUAL_STEPS[0] and float(np.median(equal)) < EQUAL_STEPS[1]:
        text = f"axis {axis + 1} is stuck: {equal[axis]:.0%} of its readings equal the one before"
        return Finding("axis_constant", text, float(equal[axis]), "share of the rows", float(equal[axis]))
    return None


def wrong_unit(h_nt: Floats, b_nt: Floats) -> Finding | None:
    """Return that readings and field differ by more than a factor of eight, and the unit that would fit.

    By that where the field is strong as well (`ratio_beyond`).
    """
    ratio = ratio_beyond(h_nt, b_nt, (1.0 / UNIT_RATIO, UNIT_RATIO)) if len(h_nt) else None
    if ratio is None:
        return None
    fits = [unit for unit, factor in NT_PER_UNIT.items() if unit != "nT" and 0.3 <= ratio * factor <= 3.0]
    named = f": {' or '.join(fits)} taken for nT?" if fits else "; raw counts, or another scale?"
    text = f"the readings are {ratio:.3g} times the field{named}"
    return Finding("unit", text, ratio, "", max(ratio, 1.0 / max(ratio, 1e-30)) / UNIT_RATIO)


def bad_rows(samples: Samples, far_share: float) -> Finding | None:
    """Return that rows are bad: screened ones, and those far from the sensor that the others show."""
    screened = float(np.mean((samples.flags & np.uint16(_SCREENED)) != 0))
    share = screened + (1.0 - screened) * far_share
    if share <= BAD_SHARE:
        return None
    text = (
        f"{share:.0%} of the rows are bad: {screened:.0%} hold no reading, {far_share:.0%} of the others lie far from "
        "the sensor that the rest shows; the residuals and flags say which"
    )
    return Finding("bad_rows", text, share, "share of the rows", share / BAD_SHARE)

"""What the weak directions mean in words, and what would help: for the person who plans the next measurement."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.observability.information import (
    SHORT_NAMES,
    WEAK_BELOW,
    ScalarInformation,
    SphereMotion,
    taking_part,
)

SHORT_S: Final = 5100.0
"""Time, s, below which errors that remember an orbit hide: in half an orbit, 95 % intervals of the bias held 70 %."""
_FLAT: Final = 0.08
"""Spread of the field's direction, root mean square, below which it stands still along an axis: 5 deg."""


def motion_words(motion: SphereMotion) -> str:
    """Return how the field moved in the sensor's frame."""
    spreads, axes = motion.spreads, motion.axes
    if spreads[2] < _FLAT:
        return "the field hardly turned in the sensor's frame"
    axis = axes[:, 0] * (np.sign(axes[np.argmax(np.abs(axes[:, 0])), 0]) or 1.0)
    named = f"({', '.join(f'{x:.2f}' for x in axis)})"
    if spreads[0] < _FLAT:
        along = abs(float(motion.centre @ axis))
        kind = "in a plane" if along < 2 * _FLAT else "on a cone"
        return f"the field moved {kind} about the sensor direction {named}: the satellite turned about one axis only"
    return f"the field moved least along the sensor direction {named}"


def weak_words(information: ScalarInformation, motion: SphereMotion) -> tuple[str, ...]:
    """Return each weak direction of a scalar calibration in words."""
    moved = motion_words(motion)
    words = []
    for direction, ratio in zip(information.weak, information.ratios, strict=True):
        names = [SHORT_NAMES[i] for i in taking_part(direction[None, :])]
        told = f"{' and '.join(names)} cannot be told apart" if len(names) > 1 else f"{names[0]} is poorly determined"
        words.append(f"{told} (signal {ratio:.1f} times the noise): {moved}")
    return tuple(words)


def vector_weak_words(index: float, spreads: Floats, directions: Floats) -> tuple[str, ...]:
    """Return the weak direction of a vector calibration in words, none where the index is good."""
    if index >= WEAK_BELOW:
        return ()
    axis = directions[:, 0] * (np.sign(directions[np.argmax(np.abs(directions[:, 0])), 0]) or 1.0)
    named = f"({', '.join(f'{x:.2f}' for x in axis)})"
    return (f"the field hardly varied along {named} of the base frame: {spreads[0]:.1%} of its size",)


def advice(index: float, motion: SphereMotion, magnitudes_nt: Floats, duration_s: float) -> tuple[str, ...]:
    """Return what would help a calibration most; empty where nothing is lacking. ``duration_s``: time covered, s."""
    found = []
    if motion.spreads[0] < 0.25:
        axis = motion.axes[:, 1]
        named = ", ".join(f"{x:.2f}" for x in axis)
        found.append(f"turn the satellite about the sensor direction ({named}) too, so that the field leaves its plane")
    if motion.coverage < 0.5:
        found.append(
            f"cover more of the sphere: the field has been near {motion.coverage:.0%} of the directions so far"
        )
    variation = float(magnitudes_nt.std() / magnitudes_nt.mean())
    if index < WEAK_BELOW and variation < 0.1:
        found.append(f"take in high and low latitudes: |B| varied by {variation:.0%} only")
    if index < WEAK_BELOW and not found:
        # Only where the motion lacks nothing is it the noise that is in the way.
        readings = max(2, round((WEAK_BELOW / max(index, 0.1)) ** 2))
        found.append(f"average {readings} readings into one: the noise is what is in the way")
    if duration_s < SHORT_S:
        found.append(
            f"measure for an orbit or more, or in several sessions: {duration_s / 60.0:.2g} minutes give the bias of "
            "that time, and errors that remember longer do not show in them"
        )
    return tuple(found)

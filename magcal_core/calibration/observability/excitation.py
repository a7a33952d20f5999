"""Whether the reference field excites every axis: measured on the field, because noise makes any reading full rank."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import CoplanarFieldError, DeadAxisError, FrameError, NoExcitationError, TooFewSamplesError

MIN_SAMPLES: Final = 5
"""Four unknowns on axis 3 and one residual."""
MIN_SPREAD: Final = 1e-5
"""Smallest spread of a field component, as a share of |B|: 0.4 nT at 40 uT, what a field model rounds to."""
MIN_SIGNIFICANCE: Final = 5.0
"""Standard errors that a gain must differ from zero by for its axis to be alive."""
TURNED_DEG: Final = 30.0
"""Turn of the reference's frame from which on an axis that seems dead is one that points elsewhere."""

_AXIS_PARAMETERS: Final = (
    ("bias_nt[0]", "scale[0]"),
    ("bias_nt[1]", "scale[1]", "nonorthogonality_deg[0]"),
    ("bias_nt[2]", "scale[2]", "nonorthogonality_deg[1]", "nonorthogonality_deg[2]"),
)


def require_excitation(b_base_nt: Floats, weights: Floats) -> None:
    """Refuse reference fields that do not determine every row of T.

    Raises
    ------
    TooFewSamplesError
        Fewer than `MIN_SAMPLES` samples have weight.
    NoExcitationError
        A component of the field is constant.
    CoplanarFieldError
        The field vectors lie in a plane, through the origin or not.
    """
    is_used = weights > 0
    used = b_base_nt if is_used.all() else b_base_nt[is_used]
    if len(used) < MIN_SAMPLES:
        raise TooFewSamplesError(f"{len(used)} usable samples, the vector methods need at least {MIN_SAMPLES}")
    size = float(np.sqrt(np.einsum("ij,ij->", used, used) / len(used)))
    centred = (used - used.mean(axis=0)) / size
    moments = np.einsum("ij,ik->jk", centred, centred) / len(used)
    spread = np.sqrt(np.diag(moments))
    for axis in range(3):
        if spread[axis] < MIN_SPREAD:
            raise NoExcitationError(
                f"axis {axis + 1}: the field along it varies by {spread[axis] * size:.3g} nT, "
                f"needed {MIN_SPREAD * size:.3g} nT",
                _AXIS_PARAMETERS[axis],
            )
    squares, directions = np.linalg.eigh(moments)
    if squares[0] < MIN_SPREAD**2:
        normal = directions[:, 0] * (np.sign(directions[np.argmax(np.abs(directions[:, 0])), 0]) or 1.0)
        shown = ", ".join(f"{x:.4f}" for x in normal)
        raise CoplanarFieldError(
            f"the field stays in a plane with the normal ({shown}) in the base frame: axis 3 cannot be told from "
            "axes 1 and 2, which alone would be determined",
            _AXIS_PARAMETERS[2],
        )


class _Turned(Protocol):
    """A fit that allows for a turned reference: its angle, deg, and whether all three axes respond in it."""

    @property
    def angle_deg(self) -> float: ...

    @property
    def is_regular(self) -> bool: ...


def require_response(axis: int, row: Floats, significance: float, own_significance: float, full: _Turned) -> None:
    """Refuse an axis whose reading does not follow the field.

    ``row``: its row of T; ``significance``: standard errors of the whole row, ``own_significance``: of the gain to its
    own field component given the others; ``full``: the fit with all nine elements of T.

    Raises
    ------
    FrameError
        The axis does respond, but the reference is in a frame that is turned far from the sensor's.
    DeadAxisError
        It does not.
    """
    is_dead = min(significance, own_significance) < MIN_SIGNIFICANCE
    if is_dead and full.is_regular and full.angle_deg > TURNED_DEG:
        raise FrameError(
            f"axis {axis + 1} responds to other components than its own: the reference is turned by "
            f"{full.angle_deg:.0f} deg from the sensor's frame; mend the axis map or the attitude"
        )
    if significance < MIN_SIGNIFICANCE:
        raise DeadAxisError(
            f"axis {axis + 1} does not respond to the field: gain {float(np.linalg.norm(row)):.3g}, "
            f"{significance:.2g} standard errors from zero, needed {MIN_SIGNIFICANCE:g}",
            _AXIS_PARAMETERS[axis],
        )
    if own_significance < MIN_SIGNIFICANCE:
        raise DeadAxisError(
            f"axis {axis + 1} says nothing that the axes before it do not say: gain {abs(row[axis]):.3g} to its own "
            f"component, {own_significance:.2g} standard errors from zero, needed {MIN_SIGNIFICANCE:g}",
            _AXIS_PARAMETERS[axis],
        )


def axis_warnings(scale: Floats, angles_deg: Floats) -> list[str]:
    """Return warnings of inverted axes and of axes that nearly lie in the span of the axes before them."""
    warnings = [
        f"inverted_axis: axis {i + 1} reads the field with the opposite sign" for i in np.flatnonzero(scale < 0)
    ]
    for i, angle in enumerate(angles_deg):
        if abs(np.cos(np.deg2rad(angle))) < 0.1:
            warnings.append(f"skewed_axis: e{i + 1} is {angle:.2f} deg, close to 90: its correction amplifies noise")
    return warnings

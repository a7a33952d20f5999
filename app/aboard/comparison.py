"""What is aboard against what was exported, number by number, and what a difference does to the corrected field."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Final, Literal

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import OptionError
from magcal_core.sensor.model import SensorModel

FIELD_NT: Final = 45_000.0
"""Size of the field at which effects are told: a low orbit's, on the large side."""
_STEPS: Final = np.array([step for step in np.ndindex(5, 5, 5) if step != (2, 2, 2)], dtype=np.float64) - 2.0
DIRECTIONS: Final = _STEPS / np.linalg.norm(_STEPS, axis=1, keepdims=True)
"""Directions all around, shape (n, 3)."""
MOST_OF_A_ROUNDING_NT: Final = 5.0
"""Numbers that are roundings of those exported and together change more than that are not the same table."""

FLIGHT_NAMES: Final = {"mgm_offset": "bias_nt", "mgm_scale": "scale", "mgm_rotation": "rotation"}
FLYING: Final = ("bias_nt", "scale", "nonorthogonality_deg", "matrix", "rotation", "correction_matrix", "regressors")

State = Literal["confirmed", "rounded", "different"]


@dataclass(frozen=True, slots=True)
class Difference:
    """A number that is not aboard as it was exported, and what it changes of the corrected field at the most."""

    name: str
    exported: float
    aboard: float
    effect_nt: float | None
    effect_deg: float | None


@dataclass(frozen=True, slots=True)
class Comparison:
    """How what is aboard stands to what was exported; the effects of all differences together."""

    state: State
    differences: Sequence[Difference]
    effect_nt: float | None
    effect_deg: float | None


def compare(
    numbers: Mapping[str, float], aboard: Mapping[str, Decimal], convention: str, *, is_single: bool
) -> Comparison:
    """Return how the numbers read back stand to those exported, ``numbers``, of ``convention``.

    Only numbers of both are compared: what is not kept aboard was not read back. ``is_single`` where the export itself
    has single-precision floats, whatever digits a number of them is written with.
    """
    kind = np.float32 if is_single else np.float64
    both = {name: float(aboard[name]) for name in numbers if name in aboard}
    with np.errstate(over="ignore"):
        changed = {name: value for name, value in both.items() if kind(value) != kind(numbers[name])}
    before = _corrected(numbers, convention)
    differences = [
        Difference(name, numbers[name], value, *_effect(before, _corrected({**numbers, name: value}, convention)))
        for name, value in changed.items()
    ]
    together = _effect(before, _corrected({**numbers, **changed}, convention))
    return Comparison(_state(numbers, aboard, changed, together[0]), differences, *together)


def _state(
    numbers: Mapping[str, float], aboard: Mapping[str, Decimal], changed: Mapping[str, float], effect_nt: float | None
) -> State:
    if not changed:
        return "confirmed"
    are_roundings = all(is_rounding(numbers[name], aboard[name]) for name in changed)
    is_small = effect_nt is not None and effect_nt <= MOST_OF_A_ROUNDING_NT
    return "rounded" if are_roundings and is_small else "different"


def is_rounding(exported: float, aboard: Decimal) -> bool:
    """Return whether ``aboard`` is ``exported`` as a single-precision float, or as written with so many decimals."""
    with np.errstate(over="ignore"):
        near = (exported, float(np.float32(exported)))
        if np.float32(float(aboard)) == np.float32(exported):
            return True
    exponent = aboard.as_tuple().exponent
    half = Decimal(5).scaleb(int(exponent) - 1)
    return any(np.isfinite(one) and abs(Decimal(one) - aboard) <= half for one in near)


def _effect(before: Floats, after: Floats) -> tuple[float | None, float | None]:
    """Return the largest change of the corrected field, nT and deg; None where the numbers are no sensor's any more."""
    change_nt = float(np.linalg.norm(after - before, axis=1).max())
    cross = np.linalg.norm(np.cross(before, after), axis=1)
    angle_deg = float(np.rad2deg(np.arctan2(cross, np.einsum("ij,ij->i", before, after))).max())
    return (change_nt, angle_deg) if np.isfinite([change_nt, angle_deg]).all() else (None, None)


def _corrected(numbers: Mapping[str, float], convention: str) -> Floats:
    """Return the fields that the table makes of readings of even directions, shape (n, 3), nT; the columns are 1."""
    found = _grouped(numbers)
    drift = [values for name, values in found.items() if name.startswith("regressors") and values.shape == (3,)]
    offset_nt = found["bias_nt"] + sum(drift, np.zeros(3))
    with np.errstate(all="ignore"):
        fields: Floats = (FIELD_NT * DIRECTIONS - offset_nt) @ _matrix(found, convention).T
    return fields


def _matrix(found: Mapping[str, Floats], convention: str) -> Floats:
    """Return the matrix by which readings are corrected, shape (3, 3); NaN where the numbers are no sensor's."""
    try:
        if convention == "exact":
            angles = found["nonorthogonality_deg"]
            return SensorModel(found["bias_nt"], found["scale"], angles).correction_matrix
        if convention == "on-board":
            return found["rotation"].reshape(3, 3) * found["scale"]
        if convention in {"lower-triangular", "symmetric"}:
            inverse = np.asarray(np.linalg.inv(found["matrix"].reshape(3, 3)), np.float64)
            return inverse if convention == "lower-triangular" else found["rotation"].reshape(3, 3) @ inverse
        return found["correction_matrix"].reshape(3, 3)
    except (np.linalg.LinAlgError, OptionError):
        return np.full((3, 3), np.nan)


def _grouped(numbers: Mapping[str, float]) -> dict[str, Floats]:
    """Return the lists that numbers named ``name[i]`` or ``name[i][j]`` are of, flat, in their order."""
    groups: dict[str, list[float]] = {}
    for name, value in numbers.items():
        groups.setdefault(plain_name(name), []).append(value)
    return {name: np.array(values) for name, values in groups.items()}


def plain_name(name: str) -> str:
    """Return what a number is of, however a form calls it: scale of ``parameters.scale[1]`` and ``MAGCAL_SCALE[1]``."""
    bare = re.sub(r"(\[\d+\])+$", "", name).removeprefix("parameters.").lower().removeprefix("magcal_")
    if bare.startswith("mgm_reg_"):
        return f"regressors.{bare.removeprefix('mgm_reg_')}"
    return FLIGHT_NAMES.get(bare, bare)


def flies(name: str) -> bool:
    """Return whether a number is one that flight software corrects with."""
    return plain_name(name).startswith(FLYING)

"""The formula of an exported convention, and one reading worked through it: what on-board code is checked against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.regressors import TIME_REGRESSOR, is_of_scale, source_of

B_NT: Final = (21000.0, -14000.0, 33000.0)
"""The field of the worked reading, in the magnetometer's base frame, nT: of the size and slant of a low orbit's."""
NO_TURN: Final[Floats] = np.eye(3)
COLUMN: Final = 1.0
"""The value of every regressor's column in the worked reading."""

MAGNITUDE: Final = "; corrected = correction_matrix * (raw - offset)"
FORMULAS: Final[Mapping[str, str]] = {
    "exact": "k = scale, e = nonorthogonality_deg; T = diag(k) * [[1, 0, 0], [sin e1, cos e1, 0], "
    "[sin e2, cos e2 sin e3, cos e2 cos e3]]; corrected = T^-1 * (raw - offset) = correction_matrix * (raw - offset)",
    "first-order": "k = scale, e = nonorthogonality_deg in rad; D = diag(k); "
    "A = D^-1 * [[1, -e1, -e2], [-e1, 1, -e3], [-e2, -e3, 1]] * D^-1; "
    f"|corrected|^2 = (raw - offset)^T * A * (raw - offset){MAGNITUDE}",
    "symmetric": "corrected = rotation * matrix^-1 * (raw - offset), rotation orthogonal; "
    "|corrected| = |matrix^-1 * (raw - offset)|",
    "lower-triangular": "corrected = matrix^-1 * (raw - offset)",
    "a-matrix": f"|corrected|^2 = (raw - offset)^T * matrix * (raw - offset){MAGNITUDE}",
    "on-board": "corrected = rotation * diag(scale) * (raw - offset), that is "
    "corrected_i = sum_j rotation_ij * scale_j * (raw_j - offset_j); scale = 1/k multiplies, rotation = P^-1 is "
    "orthogonal only where the sensing axes are",
}
"""Convention -> how a reading is corrected, or its magnitude found, with the names of the file."""


@dataclass(frozen=True, slots=True)
class Worked:
    """One reading and what becomes of it, nT; every regressor's column at `COLUMN`."""

    raw_nt: list[float]
    corrected_nt: list[float]
    magnitude_nt: float


FULL: Final = (
    "corrected = correction_matrix * (raw - offset): the matrix is full, and the parameters of this convention are "
    "those of its lower triangular factor, which give |corrected| alone"
)
"""The same where T has elements above its diagonal and the convention has none."""
_TURNED: Final = frozenset({"exact", "lower-triangular", "on-board"})
"""Conventions whose own formula ends along the sensor's axes, and not in a turned base frame."""


def formula(convention: str, regressors: Sequence[str], *, is_since: bool = False, is_full: bool = False) -> str:
    """Return how a reading in nT is corrected in ``convention``, with the names that the export has.

    ``is_since``: whether the regressor ``time`` counts since the ``time_base_utc`` of the export; ``is_full``: whether
    T has elements above its diagonal.
    """
    drift = "".join(f" + regressors.{name} * {_column(name, is_since=is_since)}" for name in regressors)
    axes = ", regressors of raw axis by axis" if any(map(is_of_scale, regressors)) else ""
    told = FULL if is_full and convention in _TURNED else FORMULAS[convention]
    return f"{told}; offset = bias_nt{drift}; raw, offset, corrected in nT{axes}"


def _column(name: str, *, is_since: bool) -> str:
    source = source_of(name)
    column = "(hours since time_base_utc)" if is_since and source == TIME_REGRESSOR else f"column {source}"
    return f"{column} * raw" if is_of_scale(name) else column


def worked(sensor: SensorModel, regressors: Mapping[str, Sequence[float]], rotation: Floats = NO_TURN) -> Worked:
    """Return a reading with few digits near `B_NT`, corrected; ``rotation``: R of T = T_low R, shape (3, 3)."""
    drift_nt, share = np.zeros(3), np.zeros(3)
    for name, change in regressors.items():
        added = share if is_of_scale(name) else drift_nt
        added += COLUMN * np.asarray(change)
    raw_nt = np.round((sensor.apply(np.array(B_NT) @ rotation.T) + drift_nt) / (1.0 - share), 1)
    corrected_nt = sensor.correct(raw_nt * (1.0 - share) - drift_nt) @ rotation
    return Worked(raw_nt.tolist(), corrected_nt.tolist(), float(np.linalg.norm(corrected_nt)))


def rotation_of_symmetric(correction_matrix: object, symmetric: object) -> list[list[float]]:
    """Return the orthogonal matrix T^-1 (T T^T)^1/2, shape (3, 3), that the symmetric convention leaves out."""
    rotation = np.asarray(correction_matrix, dtype=np.float64) @ np.asarray(symmetric, dtype=np.float64)
    found: list[list[float]] = rotation.tolist()
    return found

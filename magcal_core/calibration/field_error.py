"""How wrong the corrected field may be in its worst direction: what a calibration's covariance means to its user.

Notes
-----
A reading h = T B + b corrected with other parameters errs by dx = -T^-1 (dT B + db). With K its derivative by the
parameters at |B| = F and V their covariance, the error in the worst direction is, at 95 %,

    2 root(max over directions of the largest eigenvalue of K V K') / F.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.sphere import even_directions
from magcal_core.sensor.model import inverse_lower
from magcal_core.sensor.parameterisation import matrix_jacobian
from magcal_core.sensor.parameters import Parameters

FIELD_NT: Final = 40_000.0
"""Field at which errors are taken, nT."""
DIRECTIONS: Final = 200
SIGMAS: Final = 2.0
_LOWER: Final = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_PARTS: Final = {"bias": slice(0, 3), "scale": slice(3, 6), "angles": slice(6, 9)}


@dataclass(frozen=True, slots=True, eq=False)
class FieldError:
    """The error of the corrected field that a covariance allows, in the worst direction.

    Attributes
    ----------
    share : float
        At 95 %, as a share of the field.
    direction : shape (3,)
        Where the true field points then, base frame.
    largest : str
        Which of bias, scale and angles makes most of it there.
    """

    share: float
    direction: Floats
    largest: str


def field_error(parameters: Parameters, covariance: Floats) -> FieldError:
    """Return the error of the corrected field for ``covariance``, shape (9, 9) or more, in the order of the names.

    The bias is that at the regressors' zero: give the covariance at their mean where there are any.
    """
    matrix = parameters.matrix
    jacobian = matrix_jacobian(matrix)
    jacobian[3:] = np.rad2deg(jacobian[3:])
    back = np.zeros((9, 9))
    back[0:6, 3:9] = np.linalg.inv(jacobian)
    back[6:9, 0:3] = np.eye(3)
    derivative = -np.einsum("ij,njk,kl->nil", inverse_lower(matrix), _responses(_LOWER), back)
    found, at = _worst(derivative, covariance[:9, :9])
    names = list(_PARTS)
    sizes = [
        float(
            np.linalg.norm(
                derivative[at, :, part] @ np.nan_to_num(covariance[part, part], posinf=0.0) @ derivative[at, :, part].T
            )
        )
        for part in _PARTS.values()
    ]
    return FieldError(found, even_directions(DIRECTIONS)[at], names[int(np.argmax(sizes))])


def field_error_of_matrix(matrix: Floats, covariance: Floats) -> FieldError:
    """Return the same for all nine elements of ``matrix`` T, row by row, and the bias: ``covariance``, (12, 12)."""
    entries = tuple((i, j) for i in range(3) for j in range(3))
    derivative = -np.einsum("ij,njk->nik", np.linalg.inv(matrix), _responses(entries))
    found, at = _worst(derivative, covariance[:12, :12])
    parts = (derivative[at, :, :9] @ covariance[:9, :9], derivative[at, :, 9:12] @ covariance[9:12, 9:12])
    sizes = [
        float(np.linalg.norm(part @ own.T))
        for part, own in zip(parts, (derivative[at, :, :9], derivative[at, :, 9:12]), strict=True)
    ]
    return FieldError(found, even_directions(DIRECTIONS)[at], "matrix" if sizes[0] >= sizes[1] else "bias")


def _worst(derivative: Floats, covariance: Floats) -> tuple[float, int]:
    """Return the error at 95 %, as a share of the field, in the worst direction, and which of them it is."""
    if not np.isfinite(covariance).all():
        return float("inf"), 0
    spread = derivative @ covariance @ derivative.swapaxes(1, 2)
    largest = np.linalg.eigvalsh(0.5 * (spread + spread.swapaxes(1, 2)))[:, -1]
    at = int(np.argmax(largest))
    return float(SIGMAS * np.sqrt(max(float(largest[at]), 0.0)) / FIELD_NT), at


def _responses(entries: tuple[tuple[int, int], ...]) -> Floats:
    """Return the change of the reading by elements of T and the bias at `FIELD_NT`, shape (directions, 3, q)."""
    made = np.zeros((DIRECTIONS, 3, len(entries) + 3))
    b_nt = FIELD_NT * even_directions(DIRECTIONS)
    for column, (i, j) in enumerate(entries):
        made[:, i, column] = b_nt[:, j]
    made[:, :, len(entries) :] = np.eye(3)
    return made

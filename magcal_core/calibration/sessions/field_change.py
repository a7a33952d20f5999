"""What a change of the parameters does to the corrected field, over all directions."""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.sphere import even_directions
from magcal_core.sensor.model import matrix_of_parameters
from magcal_core.sensor.parameters import Parameters

_DIRECTIONS: Final = 64


def field_change(at: Parameters, mean_field_nt: float, step: Floats, covariance: Floats) -> tuple[float, float]:
    """Return the change of the corrected field by ``step`` and its error, nT, root mean square over directions.

    ``step`` and ``covariance``: in the order of `Parameters.names`, of which the first nine count.
    """
    jacobian = field_jacobian(at, mean_field_nt)
    count = len(jacobian) // 3
    size = float(np.sqrt(np.sum((jacobian @ step[:9]) ** 2) / count))
    error = float(np.sqrt(max(np.einsum("ij,jk,ik->", jacobian, covariance[:9, :9], jacobian), 0.0) / count))
    return size, error


def field_jacobian(at: Parameters, mean_field_nt: float) -> Floats:
    """Return the change of the corrected field, nT, by the nine parameters, shape (192, 9).

    Rows: three components in each of 64 directions of a field of ``mean_field_nt``.
    """
    b_nt = mean_field_nt * even_directions(_DIRECTIONS)
    angles_deg, scale = at.nonorthogonality_deg, at.scale
    matrix = matrix_of_parameters(scale, np.deg2rad(angles_deg))
    inverse = np.linalg.inv(matrix)
    columns = [np.tile(inverse[:, i], (len(b_nt), 1)) for i in range(3)]
    for i in range(3):
        row = np.zeros((3, 3))
        row[i] = matrix[i] / scale[i]
        columns.append(b_nt @ (inverse @ row).T)
    for i in range(3):
        nudged = angles_deg.copy()
        nudged[i] += 1e-3
        slope = (matrix_of_parameters(scale, np.deg2rad(nudged)) - matrix) / 1e-3
        columns.append(b_nt @ (inverse @ slope).T)
    return np.stack(columns, axis=-1).reshape(-1, 9)

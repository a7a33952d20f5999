"""Rotations: quaternions, scalar first, and the matrices and angles that belong to them.

A quaternion ``q = (w, qv)`` stands for the attitude of a body: ``v_body = C(q) v_reference``. Two turns one after the
other multiply in the order in which they happen: ``C(multiply(a, b)) = C(b) C(a)``.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import InputError
from magcal_core.numerics.kernel import kernel

_UNIT_TOLERANCE: Final = 1e-6


def skew(v: Floats) -> Floats:
    """Return the matrices [v x] with ``[v x] u = v x u``, shape (..., 3, 3), from vectors of shape (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def attitude_matrix(q: Floats) -> Floats:
    """Return the attitude matrices C, shape (..., 3, 3), of unit quaternions, shape (..., 4), scalar first.

    Notes
    -----
    ``v_base = C v_gcrf`` with ``C = (w^2 - |qv|^2) I + 2 qv qv^T - 2 w [qv x]``: the convention of the telemetry table.
    """
    w, v = q[..., 0, None, None], q[..., 1:]
    square = np.sum(v * v, axis=-1)[..., None, None]
    outer = v[..., :, None] * v[..., None, :]
    matrix: Floats = (w * w - square) * np.eye(3) + 2.0 * outer - 2.0 * w * skew(v)
    return matrix


def quaternion_from_matrix(matrix: Floats) -> Floats:
    """Return unit quaternions, shape (..., 4), scalar first and not negative, of attitude matrices (..., 3, 3).

    Raises
    ------
    InputError
        A matrix is not a proper rotation to 1e-6.

    Notes
    -----
    The largest of the four components is taken from the diagonal, the others from it: no loss of digits at any turn.
    """
    error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(initial=0.0)
    if not error < _UNIT_TOLERANCE or np.any(np.linalg.det(matrix) < 0.0):
        raise InputError(f"not a rotation matrix: C C^T is {error:.1e} from the identity, limit {_UNIT_TOLERANCE:.0e}")
    d = np.diagonal(matrix, axis1=-2, axis2=-1)
    trace = d.sum(axis=-1)
    gram = np.empty((*matrix.shape[:-2], 4, 4))  # 4 q q^T
    gram[..., 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        gram[..., i + 1, i + 1] = 1.0 + 2.0 * d[..., i] - trace
        gram[..., 0, i + 1] = gram[..., i + 1, 0] = matrix[..., j, k] - matrix[..., k, j]
        gram[..., j + 1, k + 1] = gram[..., k + 1, j + 1] = matrix[..., j, k] + matrix[..., k, j]
    largest = np.argmax(np.diagonal(gram, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(gram, largest[..., None, None], axis=-2)[..., 0, :]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return canonical(q)


def canonical(q: Floats) -> Floats:
    """Return the same attitudes with the scalar part not negative, shape (..., 4)."""
    return np.where(q[..., :1] < 0.0, -q, q)


def unit(q: Floats) -> Floats:
    """Return ``q`` scaled to unit length along its last axis.

    Raises
    ------
    InputError
        A quaternion has no length or is not finite.
    """
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(np.isfinite(norm) & (norm > 0.0)):
        raise InputError("a quaternion has no direction: its length is zero or not finite")
    scaled: Floats = q / norm
    return scaled


def conjugate(q: Floats) -> Floats:
    """Return the inverse turns of unit quaternions, shape (..., 4)."""
    turned_back: Floats = q * np.array([1.0, -1.0, -1.0, -1.0])
    return turned_back


def multiply(a: Floats, b: Floats) -> Floats:
    """Return the quaternion products ``a o b``, shape (..., 4): the turn ``a``, then ``b`` seen from the body."""
    wa, wb, va, vb = a[..., :1], b[..., :1], a[..., 1:], b[..., 1:]
    scalar = wa * wb - np.sum(va * vb, axis=-1, keepdims=True)
    return np.concatenate([scalar, wa * vb + wb * va + np.cross(va, vb)], axis=-1)


def rotate(q: Floats, v_reference: Floats) -> Floats:
    """Return vectors in body axes, shape (..., 3), from the same vectors in reference axes, shape (..., 3)."""
    turned: Floats = (attitude_matrix(q) @ v_reference[..., None])[..., 0]
    return turned


def rotate_rows(q: Floats, v_reference: Floats) -> Floats:
    """Return vectors in body axes, shape (n, 3), by one unit quaternion each, (n, 4): `rotate` in one compiled pass."""
    v_body = np.empty((len(q), 3))
    _rotate_rows(np.ascontiguousarray(q, np.float64), np.ascontiguousarray(v_reference, np.float64), v_body)
    return v_body


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _rotate_rows(q: Floats, v_reference: Floats, v_body: Floats) -> None:
    for i in range(len(q)):
        w, a, b, c = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        x, y, z = v_reference[i, 0], v_reference[i, 1], v_reference[i, 2]
        direct = w * w - (a * a + b * b + c * c)
        along = 2.0 * (a * x + b * y + c * z)
        v_body[i, 0] = direct * x + along * a - 2.0 * w * (b * z - c * y)
        v_body[i, 1] = direct * y + along * b - 2.0 * w * (c * x - a * z)
        v_body[i, 2] = direct * z + along * c - 2.0 * w * (a * y - b * x)


def rotation_angle(q: Floats) -> Floats:
    """Return the total angle of each turn, rad, in [0, pi], shape (...)."""
    angle_rad: Floats = 2.0 * np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), np.abs(q[..., 0]))
    return angle_rad


def from_rotation_vector(vector_rad: Floats) -> Floats:
    """Return the unit quaternions, shape (..., 4), of turns by ``|vector|`` rad about ``vector``, shape (..., 3)."""
    half = 0.5 * np.linalg.norm(vector_rad, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector_rad], axis=-1)


def euler_matrix(psi_rad: float, theta_rad: float, gamma_rad: float) -> Floats:
    """Return the matrix P = P_gamma P_theta P_psi that takes orbital to body components, shape (3, 3).

    Notes
    -----
    psi about Y (the local vertical, up), theta about Z, gamma about X, in this order (`docs/references.md`: ROM).
    """
    cy, sy = np.cos(psi_rad), np.sin(psi_rad)
    cz, sz = np.cos(theta_rad), np.sin(theta_rad)
    cx, sx = np.cos(gamma_rad), np.sin(gamma_rad)
    p_psi = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
    p_theta = np.array([[cz, sz, 0.0], [-sz, cz, 0.0], [0.0, 0.0, 1.0]])
    p_gamma = np.array([[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]])
    matrix: Floats = p_gamma @ p_theta @ p_psi
    return matrix


def euler_angles(matrix: Floats) -> tuple[float, float, float]:
    """Return psi, theta and gamma, rad, of one matrix P, shape (3, 3): theta in [-pi/2, pi/2]."""
    theta = np.arcsin(np.clip(matrix[0, 1], -1.0, 1.0))
    psi, gamma = np.arctan2(-matrix[0, 2], matrix[0, 0]), np.arctan2(-matrix[2, 1], matrix[1, 1])
    return float(psi), float(theta), float(gamma)

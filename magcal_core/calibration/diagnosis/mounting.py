"""From scalar to vector: the rotation that |B| leaves free, resolved where something else knows the direction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.affine import Affine, fit_affine
from magcal_core.errors import OptionError
from magcal_core.numerics.tails import chi_square_of_three
from magcal_core.observations import Observations
from magcal_core.sensor.model import SensorModel, lower_triangular_gauge
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import term_nt

LOWER_P: Final = 1e-3
"""Probability below which the lower-triangular hypothesis is given up."""
_MIN_SAMPLES: Final = 30
_FREE: Final = (
    "the rotation of the base frame against the satellite is free: |B| does not see it, nor that an axis is inverted; "
    "attitude or a second magnetometer would resolve it"
)


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """How the magnetometer's base frame lies in the frame of the reference.

    Attributes
    ----------
    state : str
        ``resolved``, or ``free`` where nothing knows the direction; the figures are None then.
    by : str or None
        What resolved it: ``attitude``, ``second-magnetometer``.
    rotation : shape (3, 3), optional
        R of T = T_low R: from the reference's frame to the base frame; its determinant is -1 where the sensor is
        left-handed.
    angle_deg, rotation_vector_deg, standard_errors_deg
        The proper rotation in R, as an angle and as a vector in the base frame, with honest errors a component.
    inverted_axes : tuple of int, optional
        Axes, 1 to 3, that read the field with the opposite sign.
    lower_p_value : float, optional
        Probability of T12, T13, T23 as large as found where the reference is in the base frame (Wald, honest errors).
    bias_nt, matrix : shape (3,), (3, 3), optional
        The twelve-parameter calibration h = T B + b in the reference's frame.
    """

    state: str
    text: str
    by: str | None = None
    rotation: Floats | None = None
    angle_deg: float | None = None
    rotation_vector_deg: Floats | None = None
    standard_errors_deg: Floats | None = None
    inverted_axes: tuple[int, ...] | None = None
    lower_p_value: float | None = None
    bias_nt: Floats | None = None
    matrix: Floats | None = None

    @property
    def is_lower_triangular(self) -> bool | None:
        """Whether the reference may be in the sensor's own base frame; None where it cannot be tested."""
        return None if self.lower_p_value is None else self.lower_p_value >= LOWER_P

    def to_dict(self) -> dict[str, object]:
        """Return the mounting as the records of the service have it."""
        arrays = ("rotation", "rotation_vector_deg", "standard_errors_deg", "bias_nt", "matrix")
        listed = {name: None if getattr(self, name) is None else getattr(self, name).tolist() for name in arrays}
        return {
            "state": self.state,
            "by": self.by,
            "text": self.text,
            "angle_deg": self.angle_deg,
            "inverted_axes": None if self.inverted_axes is None else list(self.inverted_axes),
            "lower_triangular_p_value": self.lower_p_value,
            "is_lower_triangular": self.is_lower_triangular,
            **listed,
        }


def mounting_of(observations: Observations, parameters: Parameters) -> Mounting:
    """Return how the sensor described by ``parameters`` is mounted, as far as ``observations`` can say.

    Parameters
    ----------
    observations : Observations
        With the field in the frame of the attitude (``b_base_nt``) where it is known; weights are respected.
    parameters : Parameters
        The calibration; its regressors are taken off the readings.

    Notes
    -----
    h = T B + b with all nine elements of T by least squares, then T = T_low R by LQ. Errors of R: with M = T_low^-1 dT
    R^T = L + [w x], L lower triangular, the elements of M above the diagonal are those of [w x].
    """
    if observations.b_base_nt is None or np.count_nonzero(observations.weights > 0) < _MIN_SAMPLES:
        return Mounting("free", _FREE)
    h_nt = observations.h_nt
    for name, slope in parameters.regressors.items():
        h_nt = h_nt - term_nt(observations.regressors[name], slope)
    b_nt = observations.b_base_nt
    if _is_flat(b_nt):
        return Mounting("free", f"the field stayed in a plane of the attitude's frame; {_FREE}")
    affine = fit_affine(observations.t_s, b_nt, h_nt, observations.weights, is_robust=True)
    return _of_affine(affine, "attitude")


def _is_flat(b_nt: Floats) -> bool:
    """Return whether the field, shape (n, 3), stays in a plane to 1e-4 of its largest component."""
    centred = b_nt - b_nt.mean(axis=0)
    thinnest = max(float(np.linalg.eigvalsh(centred.T @ centred / len(b_nt))[0]), 0.0)
    return bool(np.sqrt(thinnest) <= 1e-4 * float(np.abs(b_nt).max()))


def mounting_by_second(rotation: Floats, covariance_rad2: Floats, second: Mounting | None = None) -> Mounting:
    """Return the mounting of a first magnetometer from the rotation that takes a second one's base frame to its own.

    Parameters
    ----------
    rotation, covariance_rad2 : shape (3, 3)
        As `compare_magnetometers` finds them.
    second : Mounting, optional
        That of the second magnetometer; unless given, the result is relative to the second one's base frame.

    Raises
    ------
    OptionError
        The second one's mounting is free.
    """
    total, covariance, frame = rotation, covariance_rad2, "the second magnetometer's base frame"
    if second is not None:
        if second.rotation is None or second.standard_errors_deg is None:
            raise OptionError("the second magnetometer's own mounting is free: it resolves nothing")
        total, frame = rotation @ second.rotation, "the attitude's frame"
        errors = np.deg2rad(second.standard_errors_deg)
        covariance = covariance_rad2 + rotation @ np.diag(errors**2) @ rotation.T
    made = _described(total, covariance, "second-magnetometer", frame)
    return replace(made, lower_p_value=None)


def _of_affine(affine: Affine, by: str) -> Mounting:
    lower, rotation = lower_triangular_gauge(affine.matrix)
    inverse = np.linalg.inv(lower)
    # w1, w2, w3 from M23, M13, M12: [w x] = (0, -w3, w2; w3, 0, -w1; -w2, w1, 0).
    entries = ((1, 2, -1.0), (0, 2, 1.0), (0, 1, -1.0))
    derivative = np.stack([sign * np.outer(inverse[i], rotation[j]) for i, j, sign in entries])
    made = _described(rotation, affine.matrix_covariance(derivative), by, "the attitude's frame")
    above = np.zeros((3, 3, 3))
    above[range(3), (0, 0, 1), (1, 2, 2)] = 1.0
    values = affine.matrix[(0, 0, 1), (1, 2, 2)]
    statistic = float(values @ np.linalg.solve(affine.matrix_covariance(above), values))
    p_value = chi_square_of_three(statistic)
    test = "holds" if p_value >= LOWER_P else "does not hold"
    text = f"{made.text}; that the reference is in the sensor's own base frame {test} (p = {p_value:.2g})"
    return replace(made, text=text, lower_p_value=p_value, bias_nt=affine.offset, matrix=affine.matrix)


def _described(rotation: Floats, covariance_rad2: Floats, by: str, frame: str) -> Mounting:
    signs = _signs(rotation)
    proper = signs[:, None] * rotation
    vector = rotation_vector(proper)
    inverted = tuple(int(i) + 1 for i in np.flatnonzero(signs < 0))
    errors_deg = np.rad2deg(np.sqrt(np.diag(covariance_rad2)))
    angle = float(np.rad2deg(np.linalg.norm(vector)))
    text = f"the base frame is turned by {angle:.3g} +- {errors_deg.max():.2g} deg from {frame}"
    if inverted:
        text += f"; axis {', '.join(str(i) for i in inverted)} reads with the opposite sign: the sensor is left-handed"
    return Mounting("resolved", text, by, rotation, angle, np.rad2deg(vector), errors_deg, inverted)


def _signs(rotation: Floats) -> Floats:
    """Return the signs of the base axes that make ``rotation`` proper with the smallest angle; all 1 where it is."""
    if np.linalg.det(rotation) > 0:
        return np.ones(3)
    odd = [np.array(signs) for signs in product((1.0, -1.0), repeat=3) if np.prod(signs) < 0]
    return max(odd, key=lambda signs: float(np.trace(signs[:, None] * rotation)))


def rotation_vector(rotation: Floats) -> Floats:
    """Return angle times axis, rad, shape (3,), such that ``rotation`` = exp([vector x]); proper rotations only."""
    axial = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(axial)), 0.5 * (float(np.trace(rotation)) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return np.asarray(axial * (angle / sine))
    if cosine > 0:
        return axial
    values, vectors = np.linalg.eigh(0.5 * (rotation + rotation.T))
    return np.asarray(angle * vectors[:, int(np.argmax(values))])


def sensor_of(mounting: Mounting) -> SensorModel | None:
    """Return the sensor, in its own base frame, of the twelve-parameter fit; None where the mounting is free."""
    if mounting.matrix is None or mounting.bias_nt is None:
        return None
    return SensorModel.from_matrix(mounting.bias_nt, lower_triangular_gauge(mounting.matrix)[0])

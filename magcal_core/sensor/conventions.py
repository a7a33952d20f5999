"""Parameter conventions, loss-free from one to another: a table of readers and writers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, InputError, OptionError
from magcal_core.sensor.model import SensorModel, inverse_lower, lower_triangular_gauge, parameters_of_matrix


@dataclass(frozen=True, slots=True, eq=False)
class _Gauge:
    """What every convention can say: M = T T^T, in its Cholesky factor with the signs of the axes."""

    bias_nt: Floats
    lower: Floats
    signs: Floats

    @property
    def matrix(self) -> Floats:
        return self.lower * self.signs


def _vector(parameters: Mapping[str, object], name: str) -> Floats:
    return _numbers(parameters, name, (3,))


def _numbers(parameters: Mapping[str, object], name: str, shape: tuple[int, ...]) -> Floats:
    if name not in parameters:
        raise OptionError(f"the parameters have no {name}", [Fault(name, "missing")])
    try:
        value = np.array(parameters[name], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{name}: want numbers", [Fault(name, "want numbers")]) from error
    if value.shape != shape or not np.isfinite(value).all():
        raise OptionError(f"{name}: want finite numbers of shape {shape}", [Fault(name, f"want shape {shape}")])
    return value


def _signs(parameters: Mapping[str, object]) -> Floats:
    if parameters.get("axis_signs") is None:
        return np.ones(3)
    signs = _vector(parameters, "axis_signs")
    if np.any(np.abs(signs) != 1.0):
        raise OptionError("axis_signs: want 1 or -1 for each axis", [Fault("axis_signs", "want 1 or -1")])
    return signs


def _cholesky(m: Floats, what: str) -> Floats:
    try:
        return np.asarray(np.linalg.cholesky(m), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise OptionError(f"{what} is not positive definite: no sensor has it") from error


def _symmetric_matrix(parameters: Mapping[str, object]) -> Floats:
    matrix = _numbers(parameters, "matrix", (3, 3))
    if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
        raise OptionError("matrix: want a symmetric matrix", [Fault("matrix", "not symmetric")])
    return (matrix + matrix.T) / 2


def _gauge_of_a(a: Floats, bias_nt: Floats, signs: Floats) -> _Gauge:
    # Factor A from its last row upwards: A = L^T L with L = T^-1, without forming the inverse of A.
    upper = _cholesky(a[::-1, ::-1], "A")[::-1, ::-1]
    return _Gauge(bias_nt, inverse_lower(upper.T), signs)


def _read_exact(parameters: Mapping[str, object]) -> _Gauge:
    names = ("bias_nt", "scale", "nonorthogonality_deg")
    t = SensorModel(*(_vector(parameters, name) for name in names)).matrix
    signs = np.sign(np.diag(t))
    return _Gauge(_vector(parameters, "bias_nt"), t * signs, signs)


def _write_exact(gauge: _Gauge) -> dict[str, object]:
    model = SensorModel.from_matrix(gauge.bias_nt, gauge.matrix)
    return {"scale": model.scale.tolist(), "nonorthogonality_deg": model.nonorthogonality_deg.tolist()}


def first_order_a(scale: Floats, angles_rad: Floats) -> Floats:
    """Return A, shape (3, 3), to first order in the angles, rad, as [DEKART]_ prints it."""
    e1, e2, e3 = angles_rad
    inner = np.array([[1.0, -e1, -e2], [-e1, 1.0, -e3], [-e2, -e3, 1.0]])
    return inner / np.outer(scale, scale)


def _read_first_order(parameters: Mapping[str, object]) -> _Gauge:
    scale, angles_deg = _vector(parameters, "scale"), _vector(parameters, "nonorthogonality_deg")
    if np.any(scale == 0.0):
        raise OptionError("scale: a scale factor is zero", [Fault("scale", "zero")])
    a = first_order_a(np.abs(scale), np.deg2rad(angles_deg))
    return _gauge_of_a(a, _vector(parameters, "bias_nt"), _signs(parameters))


def _write_first_order(gauge: _Gauge) -> dict[str, object]:
    scale, angles_rad = first_order_of_a(_a_of(gauge))
    return {"scale": scale.tolist(), "nonorthogonality_deg": np.rad2deg(angles_rad).tolist(), **_sign_entry(gauge)}


def first_order_of_a(a: Floats) -> tuple[Floats, Floats]:
    """Return the first-order scale factors and angles, rad, whose A of [DEKART]_ is ``a``: a bijection.

    Notes
    -----
    k_i = A_ii^-1/2, e1 = -A12 k1 k2, e2 = -A13 k1 k3, e3 = -A23 k2 k3. They are not the k and e of the exact model.
    """
    k = 1.0 / np.sqrt(np.diag(a))
    return k, -np.array([a[0, 1] * k[0] * k[1], a[0, 2] * k[0] * k[2], a[1, 2] * k[1] * k[2]])


def _a_of(gauge: _Gauge) -> Floats:
    inverse = inverse_lower(gauge.lower)
    return inverse.T @ inverse


def _sign_entry(gauge: _Gauge) -> dict[str, object]:
    """Return the signs of the axes where one is negative: |B| cannot carry them, so they stand beside it."""
    return {} if np.all(gauge.signs > 0) else {"axis_signs": gauge.signs.tolist()}


def _read_symmetric(parameters: Mapping[str, object]) -> _Gauge:
    t = _symmetric_matrix(parameters)
    _cholesky(t, "matrix")
    lower, _ = lower_triangular_gauge(t)
    return _Gauge(_vector(parameters, "bias_nt"), lower, _signs(parameters))


def _write_symmetric(gauge: _Gauge) -> dict[str, object]:
    # The polar factor of T by its singular values: no squaring, so nothing is lost for a skewed sensor.
    u, s, _ = np.linalg.svd(gauge.lower)
    return {"matrix": ((u * s) @ u.T).tolist(), **_sign_entry(gauge)}


def _read_lower(parameters: Mapping[str, object]) -> _Gauge:
    model = SensorModel.from_matrix(_vector(parameters, "bias_nt"), _numbers(parameters, "matrix", (3, 3)))
    t = np.tril(_numbers(parameters, "matrix", (3, 3)))
    signs = np.sign(np.diag(t))
    return _Gauge(model.bias_nt, t * signs, signs)


def _write_lower(gauge: _Gauge) -> dict[str, object]:
    return {"matrix": gauge.matrix.tolist()}


def _read_a(parameters: Mapping[str, object]) -> _Gauge:
    return _gauge_of_a(_symmetric_matrix(parameters), _vector(parameters, "bias_nt"), _signs(parameters))


def _write_a(gauge: _Gauge) -> dict[str, object]:
    return {"matrix": _a_of(gauge).tolist(), **_sign_entry(gauge)}


def _read_on_board(parameters: Mapping[str, object]) -> _Gauge:
    scale, rotation = _vector(parameters, "scale"), _numbers(parameters, "rotation", (3, 3))
    diagonal = np.diag(rotation) * scale
    if not np.all(diagonal) or np.abs(np.triu(rotation, 1)).max() > 1e-12 * np.abs(rotation).max():
        raise OptionError(
            "rotation: want a lower-triangular matrix, and no scale of zero", [Fault("rotation", "not so")]
        )
    model = SensorModel.from_matrix(_vector(parameters, "bias_nt"), inverse_lower(np.tril(rotation) * scale))
    signs = np.sign(diagonal)
    return _Gauge(model.bias_nt, model.matrix * signs, signs)


def _write_on_board(gauge: _Gauge) -> dict[str, object]:
    # T^-1 = P^-1 diag(1/k): the gains of the channels first, then their directions.
    scale, _ = parameters_of_matrix(gauge.matrix)
    return {"scale": (1.0 / scale).tolist(), "rotation": inverse_lower(gauge.matrix / scale[:, None]).tolist()}


_Reader = Callable[[Mapping[str, object]], _Gauge]


_Writer = Callable[[_Gauge], dict[str, object]]


CONVENTIONS: Final[Mapping[str, tuple[_Reader, _Writer]]] = MappingProxyType(
    {
        "exact": (_read_exact, _write_exact),
        "first-order": (_read_first_order, _write_first_order),
        "symmetric": (_read_symmetric, _write_symmetric),
        "lower-triangular": (_read_lower, _write_lower),
        "a-matrix": (_read_a, _write_a),
        "on-board": (_read_on_board, _write_on_board),
    }
)
"""Convention -> how its parameters are read and written.

``exact``: ``scale``, ``nonorthogonality_deg`` of the model above. ``first-order``: the same names, [DEKART]_'s
first-order A. ``symmetric``: ``matrix`` = (T T^T)^1/2. ``lower-triangular``: ``matrix`` = T. ``a-matrix``: ``matrix`` =
A = T^-T T^-1. ``on-board``: ``scale`` = 1/k, to multiply with, and ``rotation`` = P^-1: the corrected reading is
rotation diag(scale) (h - b). Every one has ``bias_nt``; where a scale factor is negative, those that |B| determines
carry ``axis_signs``.
"""


_OWN_KEYS: Final[Sequence[str]] = (
    "bias_nt",
    "scale",
    "nonorthogonality_deg",
    "matrix",
    "rotation",
    "axis_signs",
    "convention",
)


def convert(parameters: Mapping[str, object], source: str, target: str) -> dict[str, object]:
    """Return ``parameters`` of convention ``source`` in convention ``target``, both of `CONVENTIONS`, loss-free.

    What does not depend on the convention (time offset, regressors) is passed through.

    Raises
    ------
    OptionError
        A convention is unknown, a parameter is missing or malformed, or no sensor has these parameters.
    """
    for name in (source, target):
        if name not in CONVENTIONS:
            raise OptionError(f"unknown convention {name!r}; known are {', '.join(CONVENTIONS)}")
    try:
        gauge = CONVENTIONS[source][0](parameters)
        written = CONVENTIONS[target][1](gauge)
    except (FloatingPointError, ZeroDivisionError) as error:
        raise InputError("the parameters are beyond what floating-point numbers can convert") from error
    others = {key: value for key, value in parameters.items() if key not in _OWN_KEYS}
    return {"bias_nt": gauge.bias_nt.tolist(), **written, **others}

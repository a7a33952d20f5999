"""The Earth's gravity field: EGM96 to degree and order 36, its potential, gradient and single spherical harmonics."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from math import lgamma, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.constants import EARTH_GM_KM3_S2, EARTH_RADIUS_EGM96_KM, EGM96_MAX_DEGREE
from magcal_core.errors import ModelRangeError
from magcal_core.numerics.kernel import kernel

EGM96_SHA256: Final = "cdba2e9ccffb73216aafb3f0a7665d9ca5e89166364e5d36f173d46ad02ad091"
"""SHA-256 of ``data/egm96_36.csv``, checked whenever the table is loaded."""

_GRS80_RADIUS_KM: Final = 6378.137
_GRS80_E2: Final = 0.00669438002290
_GRS80_J2: Final = 1.08263e-3

_INVERSE: Final = 1.0 / np.maximum(np.arange(EGM96_MAX_DEGREE + 3), 1)


@kernel()
def fill_solid_harmonics(x: float, y: float, z: float, radius: float, degree: int, v: Floats, w: Floats) -> None:  # noqa: PLR0917
    """Fill ``v[m, n]`` and ``w[m, n]`` with Cunningham's unnormalised functions up to ``degree``.

    Notes
    -----
    V_nm + i W_nm = (R/r)^(n+1) P_nm(sin phi) exp(i m lambda); recursion over n at fixed m (CUNNINGHAM).
    """
    scale = radius / (x * x + y * y + z * z)
    xs, ys, zs, q = x * scale, y * scale, z * scale, radius * scale
    v[0, 0] = sqrt(q)
    w[0, 0] = 0.0
    for m in range(degree + 1):
        if m > 0:
            v[m, m] = (2 * m - 1) * (xs * v[m - 1, m - 1] - ys * w[m - 1, m - 1])
            w[m, m] = (2 * m - 1) * (xs * w[m - 1, m - 1] + ys * v[m - 1, m - 1])
        if m < degree:
            v[m, m + 1] = (2 * m + 1) * zs * v[m, m]
            w[m, m + 1] = (2 * m + 1) * zs * w[m, m]
        for n in range(m + 2, degree + 1):
            one = (2 * n - 1) * zs * _INVERSE[n - m]
            two = (n + m - 1) * q * _INVERSE[n - m]
            v[m, n] = one * v[m, n - 1] - two * v[m, n - 2]
            w[m, n] = one * w[m, n - 1] - two * w[m, n - 2]


@kernel()
def gradient_from_harmonics(c: Floats, s: Floats, degree: int, v: Floats, w: Floats) -> tuple[float, float, float]:
    """Return the gradient of U in units of GM/R^2 from ``v``, ``w`` filled to ``degree + 1``, Earth-fixed.

    ``c[m, n]`` and ``s[m, n]`` are unnormalised coefficients. Degree by degree the derivatives of V_nm, W_nm are
    combinations of functions one degree higher (CUNNINGHAM).
    """
    ax = ay = az = 0.0
    for n in range(degree + 1):
        ax -= c[0, n] * v[1, n + 1]
        ay -= c[0, n] * w[1, n + 1]
        az -= (n + 1) * c[0, n] * v[0, n + 1]
    for m in range(1, degree + 1):
        for n in range(m, degree + 1):
            cn, sn = c[m, n], s[m, n]
            lower = float((n - m + 2) * (n - m + 1))
            vp, wp, vm, wm = v[m + 1, n + 1], w[m + 1, n + 1], v[m - 1, n + 1], w[m - 1, n + 1]
            ax += 0.5 * (lower * (cn * vm + sn * wm) - cn * vp - sn * wp)
            ay += 0.5 * (lower * (sn * vm - cn * wm) - cn * wp + sn * vp)
            az -= (n - m + 1) * (cn * v[m, n + 1] + sn * w[m, n + 1])
    return ax, ay, az


@kernel()
def _potentials(r_km: Floats, c: Floats, s: Floats, gm: float, radius: float) -> Floats:
    degree = c.shape[0] - 1
    v, w = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
    out = np.empty(r_km.shape[0])
    for k in range(r_km.shape[0]):
        fill_solid_harmonics(r_km[k, 0], r_km[k, 1], r_km[k, 2], radius, degree, v, w)
        total = 0.0
        for m in range(degree, -1, -1):
            for n in range(degree, m - 1, -1):
                total += c[m, n] * v[m, n] + s[m, n] * w[m, n]
        out[k] = total * gm / radius
    return out


@kernel()
def _gradients(r_km: Floats, c: Floats, s: Floats, gm: float, radius: float) -> Floats:
    degree = c.shape[0] - 1
    v, w = np.zeros((degree + 2, degree + 2)), np.zeros((degree + 2, degree + 2))
    out = np.empty((r_km.shape[0], 3))
    for k in range(r_km.shape[0]):
        fill_solid_harmonics(r_km[k, 0], r_km[k, 1], r_km[k, 2], radius, degree + 1, v, w)
        ax, ay, az = gradient_from_harmonics(c, s, degree, v, w)
        out[k, 0], out[k, 1], out[k, 2] = ax, ay, az
    return out * (gm / radius**2)


@kernel()
def _basis(r_km: Floats, index: NDArray[np.int64], norm: Floats, gm: float, radius: float) -> Floats:
    degree = norm.shape[0] - 1
    v, w = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
    out = np.empty((r_km.shape[0], index.shape[0]))
    for k in range(r_km.shape[0]):
        fill_solid_harmonics(r_km[k, 0], r_km[k, 1], r_km[k, 2], radius, degree, v, w)
        for j in range(index.shape[0]):
            n, m = index[j, 0], index[j, 1]
            value = w[m, n] if index[j, 2] else v[m, n]
            out[k, j] = value * norm[m, n] * gm / radius
    return out


def normalisation(degree: int) -> Floats:
    """Return the factors N_nm from normalised to unnormalised coefficients, shape (degree+1, degree+1), as ``[m, n]``.

    Notes
    -----
    C_nm = N_nm Cbar_nm with N_nm^2 = (2 - delta_0m)(2n + 1)(n - m)!/(n + m)! (EGM96).
    """
    factors = np.zeros((degree + 1, degree + 1))
    for n in range(degree + 1):
        for m in range(n + 1):
            ratio = np.exp(lgamma(n - m + 1) - lgamma(n + m + 1))
            factors[m, n] = sqrt((1 if m == 0 else 2) * (2 * n + 1) * ratio)
    return factors


def coefficient_index(degree: int, first: int = 2) -> NDArray[np.int64]:
    """Return the order of coefficients in a design matrix: rows (n, m, 1 for a sine), shape (k, 3).

    Degree by degree from ``first``: C_n0, C_n1, S_n1, C_n2, S_n2, ...
    """
    rows = [(n, m, sine) for n in range(first, degree + 1) for m in range(n + 1) for sine in (0, 1) if m or not sine]
    return np.array(rows, np.int64).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class GravityField:
    """A spherical-harmonic gravity field, tide-free.

    Attributes
    ----------
    c, s : shape (degree+1, degree+1)
        Fully normalised coefficients as ``c[n, m]``.
    gm_km3_s2, radius_km
        Constants of the model, km3/s2 and km.
    """

    c: Floats
    s: Floats
    gm_km3_s2: float = EARTH_GM_KM3_S2
    radius_km: float = EARTH_RADIUS_EGM96_KM

    @property
    def degree(self) -> int:
        """Highest degree and order."""
        return len(self.c) - 1

    def truncated(self, degree: int) -> GravityField:
        """Return the field up to ``degree``.

        Raises
        ------
        ModelRangeError
            The field does not reach that degree.
        """
        if not 0 <= degree <= self.degree:
            raise ModelRangeError(f"gravity degree {degree}; the model has degrees 0 to {self.degree}")
        cut = slice(0, degree + 1)
        return GravityField(self.c[cut, cut].copy(), self.s[cut, cut].copy(), self.gm_km3_s2, self.radius_km)

    def unnormalised(self) -> tuple[Floats, Floats]:
        """Return the unnormalised C and S, each of shape (degree+1, degree+1), as ``[m, n]``."""
        factors = normalisation(self.degree)
        return np.ascontiguousarray(self.c.T * factors), np.ascontiguousarray(self.s.T * factors)

    def potential_km2_s2(self, r_itrf_km: Floats) -> Floats:
        """Return the geodetic (positive) potential at ``r_itrf_km``, shape (n, 3), ITRF: shape (n,), km2/s2."""
        c, s = self.unnormalised()
        return np.asarray(_potentials(np.ascontiguousarray(r_itrf_km), c, s, self.gm_km3_s2, self.radius_km))

    def gradient_km_s2(self, r_itrf_km: Floats) -> Floats:
        """Return grad U at ``r_itrf_km``, shape (n, 3), ITRF: shape (n, 3), ITRF, km/s2."""
        c, s = self.unnormalised()
        return np.asarray(_gradients(np.ascontiguousarray(r_itrf_km), c, s, self.gm_km3_s2, self.radius_km))

    def basis_km2_s2(self, r_itrf_km: Floats, degree: int, first: int = 2) -> Floats:
        """Return the potential of each unit coefficient, shape (n, k), km2/s2, columns as in `coefficient_index`.

        Notes
        -----
        Column (n, m): GM/r (R/r)^n Pbar_nm(sin phi) cos or sin m lambda.
        """
        index, factors = coefficient_index(degree, first), normalisation(degree)
        positions = np.ascontiguousarray(r_itrf_km)
        return np.asarray(_basis(positions, index, factors, self.gm_km3_s2, self.radius_km))


@cache
def _egm96_table() -> GravityField:
    raw = resources.files("magcal_core.orbit").joinpath("data/egm96_36.csv").read_bytes()
    digest = hashlib.sha256(raw).hexdigest()
    if digest != EGM96_SHA256:
        raise ModelRangeError(f"the EGM96 table has SHA-256 {digest}, want {EGM96_SHA256}: the installation is damaged")
    shape = (EGM96_MAX_DEGREE + 1, EGM96_MAX_DEGREE + 1)
    c, s = np.zeros(shape), np.zeros(shape)
    for line in raw.decode("ascii").splitlines()[2:]:
        n, m, cosine, sine = line.split(",")
        c[int(n), int(m)], s[int(n), int(m)] = float(cosine), float(sine)
    c.setflags(write=False)
    s.setflags(write=False)
    return GravityField(c, s)


def egm96(degree: int = 12) -> GravityField:
    """Return EGM96, tide-free, up to ``degree`` and order, 0 to 36 (EGM96).

    Raises
    ------
    ModelRangeError
        The degree is outside 0 to 36, or the shipped table is not the one that was released.
    """
    return _egm96_table().truncated(degree)


def normal_field(degree: int = 12) -> GravityField:
    """Return the field of the level ellipsoid GRS80 up to ``degree``, with the GM and the radius of EGM96.

    Notes
    -----
    Even zonals J_2k = (-1)^(k+1) 3 e^2k / ((2k+1)(2k+3)) (1 - k + 5 k J_2/e^2), so U0 = GM/r (1 - sum J_2k (R/r)^2k
    P_2k): the minus sign that a positive J_2 needs (ENERGY, eq. 13). Scaled from GRS80's radius to EGM96's.
    """
    c = np.zeros((degree + 1, degree + 1))
    c[0, 0] = 1.0
    for k in range(1, degree // 2 + 1):
        shape = _GRS80_E2**k * (1 - k + 5 * k * _GRS80_J2 / _GRS80_E2)
        zonal = (-1) ** (k + 1) * 3.0 * shape / ((2 * k + 1) * (2 * k + 3))
        c[2 * k, 0] = -zonal * (_GRS80_RADIUS_KM / EARTH_RADIUS_EGM96_KM) ** (2 * k) / sqrt(4 * k + 1)
    return GravityField(c, np.zeros_like(c))


def coefficients_of(field: GravityField, degree: int) -> Floats:
    """Return the coefficients of ``field`` in the order of `coefficient_index`, 0 where it does not reach."""
    values = [
        (field.s if sine else field.c)[n, m] if n <= field.degree else 0.0 for n, m, sine in coefficient_index(degree)
    ]
    return np.array(values, np.float64)


def field_of(values: Floats, degree: int, central: float = 1.0) -> GravityField:
    """Return the field with the coefficients ``values`` in the order of `coefficient_index` and C_00 = ``central``."""
    c, s = np.zeros((degree + 1, degree + 1)), np.zeros((degree + 1, degree + 1))
    c[0, 0] = central
    for (n, m, sine), value in zip(coefficient_index(degree), values, strict=True):
        (s if sine else c)[n, m] = value
    return GravityField(c, s)

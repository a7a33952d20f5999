"""The semi-analytic method: harmonics of a circular orbit first, coefficients order by order from them."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from magcal_core.arrays import Complexes, Floats
from magcal_core.energy.terms import M2_PER_KM2, Track
from magcal_core.errors import NotObservableError
from magcal_core.orbit.propagators.forces import cip_axis_gcrf
from magcal_core.orbit.propagators.gravity import GravityField, coefficient_index, field_of

MAX_ITERATIONS: Final = 60

_CONVERGED: Final = 1e-13
_RIDGE: Final = 1e-10
_BLOCK: Final = 4096


def orbit_angles(track: Track) -> tuple[Floats, Floats, float, float]:
    """Return u and the longitude of the node, each of shape (n,), rad, mean radius, km, and mean inclination, rad.

    u is the argument of latitude; node and inclination refer to the equator of the turning Earth.
    """
    r_itrf_km = track.r_itrf_km
    axis = cip_axis_gcrf(track.t_s, track.tables)
    normal = np.cross(track.r_km, track.v_km_s)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    node = np.cross(axis, normal)
    node /= np.linalg.norm(node, axis=1, keepdims=True)
    u_rad = np.arctan2(np.vecdot(track.r_km, np.cross(normal, node)), np.vecdot(track.r_km, node))
    inclination_rad = float(np.arccos(np.vecdot(axis, normal)).mean())
    from_node_rad = np.arctan2(np.cos(inclination_rad) * np.sin(u_rad), np.cos(u_rad))
    node_rad = np.arctan2(r_itrf_km[:, 1], r_itrf_km[:, 0]) - from_node_rad
    return u_rad, node_rad, float(np.linalg.norm(track.r_km, axis=1).mean()), inclination_rad


def circle_harmonics(field: GravityField, degree: int, radius_km: float, inclination_rad: float) -> Complexes:
    """Return ``a[m, n, k + degree]``, m2/s2: the amplitude of exp i(k u + m Lambda) that a unit C_nm - i S_nm makes.

    Notes
    -----
    GM/r (R/r)^n F_nmk(I): the inclination functions F are the Fourier series of Pbar_nm(sin phi) exp i m(lambda -
    Lambda) round the circle, where sin phi = sin I sin u.
    """
    size = 4 * degree + 4
    u_rad = 2.0 * np.pi * np.arange(size) / size
    along = [np.cos(u_rad), np.cos(inclination_rad) * np.sin(u_rad), np.sin(inclination_rad) * np.sin(u_rad)]
    basis = field.basis_km2_s2(radius_km * np.stack(along, axis=1), degree) * M2_PER_KM2
    amplitudes = np.zeros((degree + 1, degree + 1, 2 * degree + 1), np.complex128)
    for j, (n, m, sine) in enumerate(coefficient_index(degree)):
        spectrum = np.fft.fft(basis[:, j]) / size
        amplitudes[m, n] += (1j if sine else 1.0) * spectrum[np.arange(-degree, degree + 1)]
    return amplitudes


class _Torus:
    """Least squares for the harmonics exp i(k u + m Lambda) of samples on the torus of u and Lambda."""

    def __init__(self, u_rad: Floats, node_rad: Floats, degree: int) -> None:
        self._u, self._node, self._degree = np.exp(1j * u_rad), np.exp(1j * node_rad), degree
        pairs = [(m, k) for m in range(degree + 1) for k in range(-degree if m else 0, degree + 1)]
        self._m, self._k = (np.array(column) for column in zip(*pairs, strict=True))
        size = 2 * len(self._m)
        normal = np.zeros((size, size))
        for start in range(0, len(u_rad), _BLOCK):
            design = self._design(slice(start, start + _BLOCK))
            normal += design.T @ design
        normal[np.diag_indices(size)] += _RIDGE * len(u_rad)
        self._factor = cho_factor(normal)

    def _design(self, rows: slice) -> Floats:
        along = self._u[rows, None] ** np.arange(-self._degree, self._degree + 1)
        around = self._node[rows, None] ** np.arange(self._degree + 1)
        wave = along[:, self._k + self._degree] * around[:, self._m]
        return np.concatenate([wave.real, -wave.imag], axis=1)

    def harmonics(self, y: Floats) -> Complexes:
        """Return the complex amplitudes of ``y``, shape (n,), as ``[m, k + degree]``; m = 0 has k of 0 and more."""
        right = np.zeros(2 * len(self._m))
        for start in range(0, len(y), _BLOCK):
            rows = slice(start, start + _BLOCK)
            right += self._design(rows).T @ y[rows]
        parts = np.asarray(cho_solve(self._factor, right))
        out = np.zeros((self._degree + 1, 2 * self._degree + 1), np.complex128)
        out[self._m, self._k + self._degree] = parts[: len(self._m)] + 1j * parts[len(self._m) :]
        return out


def _order_by_order(amplitudes: Complexes, lumped: Complexes) -> Floats:
    """Return the coefficients, in the order of `coefficient_index`, that explain the lumped ones, a fit an order."""
    degree = len(amplitudes) - 1
    found: dict[tuple[int, int], complex] = {}
    for m in range(degree + 1):
        degrees = np.arange(max(2, m), degree + 1)
        design, right = amplitudes[m, degrees].T, lumped[m]
        if m == 0:
            later = slice(degree + 1, None)
            halves = 2.0 * design[later], right[later]
            design, right = (np.concatenate([half.real, half.imag]) for half in halves)
        solution = np.linalg.lstsq(design, right, rcond=1e-12)[0]
        found |= {(int(n), m): complex(value) for n, value in zip(degrees, solution, strict=True)}
    values = [-found[n, m].imag if sine else found[n, m].real for n, m, sine in coefficient_index(degree)]
    return np.array(values, np.float64)


def semi_analytic_coefficients(track: Track, y_m2_s2: Floats, degree: int) -> tuple[Floats, float, float]:
    """Return coefficients in the order of `coefficient_index`, H and the residuals' rms, m2/s2, from ``y_m2_s2``.

    Raises
    ------
    NotObservableError
        The track is too short or too far from a circle for the iteration to settle.

    Notes
    -----
    The potential on a circle is a Fourier series on the torus of argument of latitude and node, and each order m of it
    depends on the coefficients of that order alone: one large system becomes many small ones. What the real orbit's
    eccentricity and precession leave is computed along the track itself and fed back until it settles.
    """
    u_rad, node_rad, radius_km, inclination_rad = orbit_angles(track)
    torus = _Torus(u_rad, node_rad, degree)
    amplitudes = circle_harmonics(track.field, degree, radius_km, inclination_rad)
    r_itrf_km = track.r_itrf_km
    values = np.zeros(len(coefficient_index(degree)))
    rest = y_m2_s2
    before = np.inf
    for _ in range(MAX_ITERATIONS):
        step = _order_by_order(amplitudes, torus.harmonics(rest - rest.mean()))
        size = float(np.abs(step).max())
        if size > 2.0 * before:
            break
        values, before = values + step, size
        rest = y_m2_s2 - field_of(values, degree, 0.0).potential_km2_s2(r_itrf_km) * M2_PER_KM2
        if size < _CONVERGED:
            return values, float(rest.mean()), float(rest.std())
    raise NotObservableError(f"the semi-analytic method does not settle on this track: last change {size:.1e}")

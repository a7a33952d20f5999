"""Gravity coefficients from the energy balance: by least squares, by collocation, by the semi-analytic method."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular

from magcal_core.arrays import Floats
from magcal_core.energy.forms import FORMS
from magcal_core.energy.options import EnergyOptions
from magcal_core.energy.semi_analytic import semi_analytic_coefficients
from magcal_core.energy.terms import M2_PER_KM2, Series, Track, kinetic_m2_s2, rotation_m2_s2
from magcal_core.errors import NotObservableError, TooFewSamplesError
from magcal_core.orbit.propagators.gravity import (
    GravityField,
    coefficient_index,
    coefficients_of,
    field_of,
    normal_field,
)

KAULA: Final = 1e-5
"""Kaula's rule: a normalised coefficient of degree n has a spread of 1e-5/n^2."""

_BLOCK: Final = 4096
_RANK: Final = 1e-13


@dataclass(frozen=True, slots=True, eq=False)
class Recovery:
    """Recovered coefficients beside the field they are compared with.

    Attributes
    ----------
    field : GravityField
        What was recovered, fully normalised.
    reference : GravityField
        The field of the simulation, or EGM96 where the states are someone else's.
    constant_m2_s2 : float
        H, recovered with the coefficients.
    covariance : shape (k, k), optional
        Of the coefficients in the order of `coefficient_index`; the semi-analytic method has none.
    residual_rms_m2_s2 : float
        RMS of what the coefficients leave over.
    """

    method: str
    field: GravityField
    reference: GravityField
    constant_m2_s2: float
    covariance: Floats | None
    residual_rms_m2_s2: float

    @property
    def degree(self) -> int:
        """Highest degree recovered."""
        return self.field.degree

    @property
    def standard_errors(self) -> Floats | None:
        """1-sigma errors in the order of `coefficient_index`, shape (k,)."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    @property
    def errors(self) -> Floats:
        """Recovered less reference in the order of `coefficient_index`, shape (k,)."""
        return coefficients_of(self.field, self.degree) - coefficients_of(self.reference, self.degree)

    @property
    def rms_error(self) -> float:
        """RMS over all coefficients of recovered less reference."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def error_by_degree(self) -> Floats:
        """RMS error of the coefficients of each degree from 2 on, shape (degree - 1,)."""
        return _rms_by_degree(self.errors, self.degree)

    @property
    def signal_by_degree(self) -> Floats:
        """RMS of the reference's coefficients of each degree from 2 on, shape (degree - 1,)."""
        return _rms_by_degree(coefficients_of(self.reference, self.degree), self.degree)

    @property
    def relative_error_by_degree(self) -> tuple[float, ...]:
        """RMS error over RMS signal for each degree from 2 on; NaN where the reference has no signal."""
        pairs = zip(self.error_by_degree, self.signal_by_degree, strict=True)
        return tuple(float(error / signal) if signal > 0.0 else float("nan") for error, signal in pairs)

    def to_dict(self) -> dict[str, object]:
        """Return the recovery as JSON takes it; the covariance is left out, its standard errors are not."""
        errors = self.standard_errors
        at = {(int(n), int(m), int(sine)): j for j, (n, m, sine) in enumerate(coefficient_index(self.degree))}
        rows: list[dict[str, float | int]] = []
        for n in range(2, self.degree + 1):
            for m in range(n + 1):
                row: dict[str, float | int] = {"n": n, "m": m, "c": self.field.c[n, m], "s": self.field.s[n, m]}
                if errors is not None:
                    row |= {"c_se": float(errors[at[n, m, 0]]), "s_se": float(errors[at[n, m, 1]]) if m else 0.0}
                rows.append({key: value if isinstance(value, int) else float(value) for key, value in row.items()})
        relative = [value if np.isfinite(value) else None for value in self.relative_error_by_degree]
        return {
            "degree": self.degree,
            "method": self.method,
            "rms_error": self.rms_error,
            "relative_error_by_degree": relative,
            "residual_rms_m2_s2": self.residual_rms_m2_s2,
            "coefficients": rows,
        }


def _rms_by_degree(values: Floats, degree: int) -> Floats:
    degrees = coefficient_index(degree)[:, 0]
    return np.array([np.sqrt(np.mean(values[degrees == n] ** 2)) for n in range(2, degree + 1)])


def noisy(track: Track, options: EnergyOptions) -> Track:
    """Return ``track`` with white noise on positions and velocities, as ``options`` say."""
    if options.noise_position_m == 0.0 and options.noise_velocity_m_s == 0.0:
        return track
    generator = np.random.default_rng(options.seed)
    r_km = track.r_km + generator.normal(size=track.r_km.shape) * (options.noise_position_m / 1e3)
    v_km_s = track.v_km_s + generator.normal(size=track.v_km_s.shape) * (options.noise_velocity_m_s / 1e3)
    return replace(track, r_km=r_km, v_km_s=v_km_s)


def observations_m2_s2(track: Track, terms: Series, form: str, degree: int) -> Floats:
    """Return y = H + sum of the unknown harmonics at each state, shape (n,), m2/s2.

    Notes
    -----
    y = v^2/2 - w.(r x v) - GM/r - int a.(v - w x r) dt - E_tid (ENERGY), with the change of w taken along; degrees of
    the track's field above ``degree`` are known and taken off. Other forms show what each of their errors costs.
    """
    own = {**terms, "kinetic": kinetic_m2_s2(track), "rotation": rotation_m2_s2(track)}
    known = FORMS["frame-rate" if form == "corrected" else form](track, own)
    rest = track.field.truncated(track.field.degree)
    cut = slice(2, degree + 1)
    rest.c[cut, cut] = 0.0
    rest.c[cut, :2] = 0.0
    rest.s[cut, :] = 0.0
    return np.asarray(known - rest.potential_km2_s2(track.r_itrf_km) * M2_PER_KM2)


def _column_scales(track: Track, degree: int) -> Floats:
    """Return the size of each column of the design, with that of H last, shape (k+1,), m2/s2."""
    mean_km = float(np.linalg.norm(track.r_km, axis=1).mean())
    n = coefficient_index(degree)[:, 0]
    field = track.field
    sizes = field.gm_km3_s2 / mean_km * (field.radius_km / mean_km) ** n * M2_PER_KM2
    return np.append(sizes, 1.0)


def _triangle(track: Track, y_m2_s2: Floats, degree: int, scales: Floats) -> Floats:
    """Return the triangular factor of the scaled design with ``y`` as its last column, block by block."""
    r_itrf_km = track.r_itrf_km
    k = len(scales)
    triangle = np.zeros((0, k + 1))
    for start in range(0, len(y_m2_s2), _BLOCK):
        rows = slice(start, start + _BLOCK)
        basis = track.field.basis_km2_s2(r_itrf_km[rows], degree) * M2_PER_KM2
        design = np.column_stack([basis, np.ones(len(basis))]) / scales
        stacked = np.vstack([triangle, np.column_stack([design, y_m2_s2[rows]])])
        triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    return triangle


def recover(track: Track, terms: Series, options: EnergyOptions) -> Recovery:
    """Return the coefficients of degrees 2 to ``options.recover`` and H, seen through the noise of ``options``.

    Raises
    ------
    TooFewSamplesError
        Fewer samples than unknowns.
    NotObservableError
        The track does not tell some coefficients apart.

    Notes
    -----
    ``least-squares``: QR of the column-scaled design; covariance from the residuals. ``collocation``: the same
    observations with the coefficients' spread of Kaula's rule about the normal field as prior, which for harmonics of
    finite degree equals C_sl (C_ll + C_nn)^-1 l. ``semi-analytic``: `semi_analytic_coefficients`. Degrees 0 and 1 are
    left out: the first looks like H on a near-circular orbit, the second is 0 by the choice of the origin (ENERGY).
    """
    degree = options.recover or 2
    seen = noisy(track, options)
    y_m2_s2 = observations_m2_s2(seen, terms, options.form, degree)
    unknowns = len(coefficient_index(degree)) + 1
    if len(y_m2_s2) <= unknowns:
        raise TooFewSamplesError(f"{len(y_m2_s2)} samples for {unknowns} unknowns; degree {degree} needs more")
    if options.method == "semi-analytic":
        values, constant, rms = semi_analytic_coefficients(seen, y_m2_s2, degree)
        return Recovery(options.method, field_of(values, degree), track.field, constant, None, rms)
    scales = _column_scales(seen, degree)
    triangle = _triangle(seen, y_m2_s2 - y_m2_s2.mean(), degree, scales)
    diagonal = np.abs(np.diag(triangle))[:unknowns]
    if diagonal.min() < _RANK * diagonal.max():
        n, m, sine = [*coefficient_index(degree), (0, 0, 0)][int(diagonal.argmin())]
        name = f"{'S' if sine else 'C'}_{n},{m}"
        raise NotObservableError(f"{len(y_m2_s2)} samples do not determine {name} apart from the others", [name])
    sigma = float(np.abs(triangle[unknowns, unknowns])) / np.sqrt(len(y_m2_s2) - unknowns)
    root, right = triangle[:unknowns, :unknowns], triangle[:unknowns, unknowns]
    if options.method == "collocation":
        root, right = _with_prior(root, right, degree, scales, sigma)
    solution = solve_triangular(root, right)
    inverse = solve_triangular(root, np.eye(unknowns))
    covariance = sigma**2 * (inverse @ inverse.T) / np.outer(scales, scales)
    misfit = triangle[:unknowns, unknowns] - triangle[:unknowns, :unknowns] @ solution
    rms = float(np.sqrt((misfit @ misfit + triangle[unknowns, unknowns] ** 2) / len(y_m2_s2)))
    values = solution / scales
    return Recovery(
        method=options.method,
        field=field_of(values[:-1], degree),
        reference=track.field,
        constant_m2_s2=float(values[-1] + y_m2_s2.mean()),
        covariance=covariance[:-1, :-1],
        residual_rms_m2_s2=rms,
    )


def _with_prior(root: Floats, right: Floats, degree: int, scales: Floats, sigma: float) -> tuple[Floats, Floats]:
    """Return the triangular factor and right-hand side with Kaula's rule about the normal field as observations."""
    n = coefficient_index(degree)[:, 0]
    weights = sigma / (KAULA / n**2) / scales[:-1]
    expected = coefficients_of(normal_field(degree), degree) * scales[:-1]
    prior = np.column_stack([np.diag(weights), np.zeros(len(n)), weights * expected])
    stacked = np.asarray(np.linalg.qr(np.vstack([np.column_stack([root, right]), prior]), mode="r"))
    k = len(root)
    return stacked[:k, :k], stacked[:k, k]

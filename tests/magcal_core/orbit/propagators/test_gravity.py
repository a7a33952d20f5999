"""EGM96: against its own definition by Legendre functions, a finite difference and the closed form of J2."""

from pathlib import Path

import numpy as np
import pytest
import satkit_data
from scipy.special import sph_legendre_p_all

from magcal_core.constants import EARTH_GM_KM3_S2, EARTH_RADIUS_EGM96_KM
from magcal_core.errors import ModelRangeError
from magcal_core.orbit.propagators import gravity
from magcal_core.orbit.propagators.gravity import coefficient_index, egm96, normal_field

RNG = np.random.default_rng(20220219)
DIRECTIONS = RNG.normal(size=(200, 3))
POSITIONS_KM = 6938.0 * DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


def potential_by_definition(r_km: np.ndarray, degree: int) -> float:
    """GM/r sum (R/r)^n Pbar_nm(sin phi)(C cos m lam + S sin m lam), Legendre functions of scipy."""
    field = egm96(degree)
    radius = float(np.linalg.norm(r_km))
    longitude = np.arctan2(r_km[1], r_km[0])
    polar = np.arccos(r_km[2] / radius)
    harmonics = sph_legendre_p_all(degree, degree, polar)[0]
    total = 0.0
    for n in range(degree + 1):
        for m in range(n + 1):
            # geodetic normalisation: 4 pi, without the Condon-Shortley phase
            legendre = harmonics[n, m] * (-1) ** m * np.sqrt(4 * np.pi) * (1 if m == 0 else np.sqrt(2))
            wave = field.c[n, m] * np.cos(m * longitude) + field.s[n, m] * np.sin(m * longitude)
            total += (EARTH_RADIUS_EGM96_KM / radius) ** n * legendre * wave
    return EARTH_GM_KM3_S2 / radius * total


@pytest.mark.parametrize("degree", [0, 2, 12, 36])
def test_potential_follows_its_definition(degree: int) -> None:
    """Both sums round at a few 1e-15 of 57 km2/s2."""
    ours = egm96(degree).potential_km2_s2(POSITIONS_KM[:20])
    want = [potential_by_definition(r, degree) for r in POSITIONS_KM[:20]]
    np.testing.assert_allclose(ours, want, rtol=1e-14)


@pytest.mark.parametrize("degree", [2, 12, 36])
def test_gradient_is_the_derivative_of_the_potential(degree: int) -> None:
    """Central difference over 20 m: truncation 1e-12 km/s2, rounding 1e-12 km/s2."""
    field, h_km = egm96(degree), 1e-2
    numeric = np.stack(
        [
            (field.potential_km2_s2(POSITIONS_KM + h_km * e) - field.potential_km2_s2(POSITIONS_KM - h_km * e))
            / (2 * h_km)
            for e in np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(field.gradient_km_s2(POSITIONS_KM), numeric, atol=5e-12)


def test_poles_and_equator_are_ordinary_places() -> None:
    places_km = 7000.0 * np.vstack([np.eye(3), -np.eye(3)])
    field = egm96(36)
    gradient = field.gradient_km_s2(places_km)
    assert np.all(np.isfinite(gradient))
    near = field.gradient_km_s2(places_km + 1e-6)
    np.testing.assert_allclose(gradient, near, atol=1e-11)


def test_unit_coefficients_sum_to_the_potential() -> None:
    field, index = egm96(12), coefficient_index(12, first=0)
    coefficients = np.array([(field.s if sine else field.c)[n, m] for n, m, sine in index])
    summed = field.basis_km2_s2(POSITIONS_KM, 12, first=0) @ coefficients
    np.testing.assert_allclose(summed, field.potential_km2_s2(POSITIONS_KM), rtol=3e-15)
    assert len(coefficient_index(12)) == 165


def test_potential_is_harmonic() -> None:
    """Laplace: the trace of the numerical Hessian vanishes against its size 1e-6 /s2."""
    field, h_km = egm96(12), 0.1
    trace = sum(
        (field.gradient_km_s2(POSITIONS_KM + h_km * e) - field.gradient_km_s2(POSITIONS_KM - h_km * e))[:, k]
        / (2 * h_km)
        for k, e in enumerate(np.eye(3))
    )
    assert np.abs(trace).max() < 1e-13


def test_degree_outside_the_table_is_refused() -> None:
    for degree in (-1, 37):
        with pytest.raises(ModelRangeError, match="0 to 36"):
            egm96(degree)


def test_a_damaged_table_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gravity, "EGM96_SHA256", "0" * 64)
    gravity._egm96_table.cache_clear()
    with pytest.raises(ModelRangeError, match="damaged"):
        egm96(2)


@pytest.mark.slow
def test_shipped_table_is_that_of_the_published_model() -> None:
    """Every coefficient of degrees 2 to 36 against the EGM96.gfc of satkit-data, printed to 13 digits."""
    field, seen = egm96(36), 0
    with (Path(satkit_data.__file__).parent / "data" / "EGM96.gfc").open(encoding="ascii", errors="replace") as lines:
        for line in lines:
            parts = line.replace("D", "e").split()
            if len(parts) >= 5 and parts[0] == "gfc" and 2 <= int(parts[1]) <= 36:
                n, m = int(parts[1]), int(parts[2])
                assert field.c[n, m] == pytest.approx(float(parts[3]), rel=1e-12)
                assert field.s[n, m] == pytest.approx(float(parts[4]), rel=1e-12)
                seen += 1
    assert seen == sum(n + 1 for n in range(2, 37))


def test_normal_field_is_that_of_grs80() -> None:
    """J_4, J_6, J_8 as published by H. Moritz (Geodetic Reference System 1980), scaled between the two radii."""
    field = normal_field(12)
    published = {2: 1.08263e-3, 4: -2.37091222e-6, 6: 6.08347e-9, 8: -1.427e-11}
    for n, want in published.items():
        zonal = -field.c[n, 0] * np.sqrt(2 * n + 1) * (EARTH_RADIUS_EGM96_KM / 6378.137) ** n
        assert zonal == pytest.approx(want, rel=1e-4 if n == 8 else 1e-6)
    assert np.abs(egm96(12).c[2, 0] - field.c[2, 0]) < 5e-9

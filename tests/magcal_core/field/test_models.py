"""The dipole and the models by name."""

import numpy as np
import pytest

from magcal_core.errors import ModelRangeError, OptionError
from magcal_core.field.dipole import DirectDipole
from magcal_core.field.models import FIELD_MODELS, field_model, is_field_name

WHEN = np.datetime64("2022-01-01", "ns")


def test_dipole_points_north_at_the_equator_and_is_twice_as_strong_at_the_poles() -> None:
    """Closed form at 6371.2 km: 30036 nT at the equator, 60072 nT into the ground in the north, out in the south."""
    r_km = 6371.2 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    want_nt = [[0.0, 0.0, 30036.0], [0.0, 0.0, -60072.0], [0.0, 0.0, -60072.0]]
    np.testing.assert_allclose(DirectDipole().field_itrf_nt(np.full(3, WHEN), r_km), want_nt, rtol=1e-14, atol=1e-9)


def test_dipole_is_the_gradient_of_its_potential() -> None:
    """B = -grad V with V = -B0 a^3 z / r^3, central differences over 20 m: 1e-4 nT of truncation and rounding."""

    def potential(r_km: np.ndarray) -> float:
        return float(-30036.0 * 6371.2**3 * r_km[2] / np.linalg.norm(r_km) ** 3)

    place_km, step_km = np.array([4000.0, -3000.0, 4500.0]), 0.01
    steps = np.eye(3) * step_km
    slope = [(potential(place_km + s) - potential(place_km - s)) / (2 * step_km) for s in steps]
    field_nt = DirectDipole().field_itrf_nt(np.array([WHEN]), place_km[None])[0]
    np.testing.assert_allclose(field_nt, np.negative(slope), rtol=0, atol=1e-3)


def test_dipole_reaches_geostationary_orbit_but_not_underground() -> None:
    assert DirectDipole().field_itrf_nt(np.array([WHEN]), np.array([[42164.0, 0.0, 0.0]]))[0, 2] > 100.0
    for radius_km in (0.0, 5000.0, np.nan):
        with pytest.raises(ModelRangeError, match="sample 0"):
            DirectDipole().field_itrf_nt(np.array([WHEN]), np.array([[radius_km, 0.0, 0.0]]))


SELF_SUFFICIENT = ("igrf", "igrf-14", "igrf-13", "dipole", "igrf-14+mean")
"""Models that need no index and no file; tests/magcal_core/field/test_sources.py has the others."""


@pytest.mark.parametrize("name", SELF_SUFFICIENT)
def test_every_model_has_a_finite_field_in_low_orbit(name: str) -> None:
    r_km = np.array([[6900.0, 0.0, 0.0], [0.0, 0.0, -6900.0]])
    field_nt = FIELD_MODELS[name]().field_itrf_nt(np.full(2, WHEN), r_km)
    assert field_nt.shape == (2, 3)
    assert ((np.linalg.norm(field_nt, axis=1) > 15_000) & (np.linalg.norm(field_nt, axis=1) < 65_000)).all()


def test_models_are_chosen_by_name_degree_and_epoch() -> None:
    assert field_model("igrf").name == "igrf-14"
    assert field_model("igrf-13", 9).name == "igrf-13-9x9"
    assert field_model("igrf-13", 9, np.datetime64("2020-01-01")).name == "igrf-13-9x9@2020-01-01"
    assert field_model("dipole").name == "dipole"
    with pytest.raises(OptionError, match="'wmm'"):
        field_model("wmm")
    with pytest.raises(OptionError, match="no degree"):
        field_model("dipole", 9)


@pytest.mark.parametrize(
    "name", ["igrf-14", "igrf-13-9x9", "igrf-14-1x1", "igrf-13@2020-01-01", "igrf-13-9x9@2020-01-01"]
)
def test_a_models_own_name_gives_it_back(name: str) -> None:
    assert is_field_name(name)
    assert field_model(name).name == name


@pytest.mark.parametrize(
    "name", ["igrf-12", "igrf-13-9x8", "igrf-13@yesterday", "dipole-9x9", "igrf-13-9x9 ", "", "IGRF"]
)
def test_names_of_no_model_are_refused(name: str) -> None:
    assert not is_field_name(name)
    with pytest.raises(OptionError, match="unknown field model"):
        field_model(name)


def test_days_and_degrees_that_do_not_exist_are_refused() -> None:
    with pytest.raises(OptionError, match="no day 2020-02-31"):
        field_model("igrf-13@2020-02-31")
    with pytest.raises(ModelRangeError, match="max_degree is 14"):
        field_model("igrf-14-14x14")
    with pytest.raises(ModelRangeError, match="valid from"):
        field_model("igrf-13@2026-01-01")

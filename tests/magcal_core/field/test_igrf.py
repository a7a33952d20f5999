"""The IGRF kernel against ppigrf and chaosmagpy, and at the edges of its validity."""

import importlib.util
import warnings
from datetime import datetime
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.errors import ModelRangeError, TimeError
from magcal_core.field.igrf import Igrf

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

UNTIL = {14: "2030-01-01", 13: "2025-01-01"}
POINTS = 10_000


@pytest.fixture(scope="module")
def shc_folder() -> str:
    spec = importlib.util.find_spec("ppigrf")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    return spec.submodule_search_locations[0]


@pytest.fixture(scope="module")
def chaosmagpy() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns that Matplotlib is not installed
        return importlib.import_module("chaosmagpy")


def _times(version: int, n: int, seed: int) -> Times:
    ends = np.array(["1900-01-01", UNTIL[version]], "datetime64[ns]").astype(np.int64)
    t_utc = np.random.default_rng(seed).integers(ends[0], ends[1] + 1, n)
    t_utc[:2] = ends
    return t_utc.view("datetime64[ns]")


def _places_km(n: int, seed: int) -> Floats:
    """Random places from the ground to 2000 km, the equator, the date line and both poles' neighbourhood among them."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(n, 3))
    towards[2:102, 2] = 0.0
    towards[102:202, 1] = 0.0
    towards[102:202, 0] = -np.abs(towards[102:202, 0])
    towards[202:302, :2] *= 1e-3
    places_km: Floats = towards * (rng.uniform(6371.2, 8371.2, n) / np.linalg.norm(towards, axis=1))[:, None]
    return places_km


def _spherical(r_km: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Radius, colatitude and longitude in deg, and the axes radial, south, east as rows, shape (n, 3, 3)."""
    radius_km = np.linalg.norm(r_km, axis=1)
    theta = np.arctan2(np.hypot(r_km[:, 0], r_km[:, 1]), r_km[:, 2])
    phi = np.arctan2(r_km[:, 1], r_km[:, 0])
    st, ct, sp, cp = np.sin(theta), np.cos(theta), np.sin(phi), np.cos(phi)
    zero = np.zeros_like(st)
    axes = np.stack(
        [np.stack([st * cp, st * sp, ct], 1), np.stack([ct * cp, ct * sp, -st], 1), np.stack([-sp, cp, zero], 1)], 1
    )
    return radius_km, np.degrees(theta), np.degrees(phi), axes


@pytest.mark.parametrize("version", [14, 13])
def test_agrees_with_chaosmagpy_to_1e_minus_6_nt(version: int, shc_folder: str, chaosmagpy: ModuleType) -> None:
    """Same coefficients, linear in days between knots; double precision leaves 1e-9 nT."""
    t_utc, r_km = _times(version, POINTS, 1), _places_km(POINTS, 2)
    model = chaosmagpy.chaos.BaseModel.from_shc(f"{shc_folder}/IGRF{version}.shc", leap_year=True)
    days = (t_utc - np.datetime64("2000-01-01", "ns")) / np.timedelta64(1, "D")
    radius_km, theta_deg, phi_deg, axes = _spherical(r_km)
    want_nt = np.stack(model.synth_values(days, radius_km, theta_deg, phi_deg), 1)
    field_nt = Igrf(version).field_itrf_nt(t_utc, r_km)
    np.testing.assert_allclose(np.matvec(axes, field_nt), want_nt, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("version", "max_degree"), [(14, 13), (13, 13), (13, 9), (14, 1)])
def test_agrees_with_ppigrf_to_1e_minus_3_nt(version: int, max_degree: int, shc_folder: str) -> None:
    """ppigrf crosses dates with places, so places are grouped by date: 20 dates, 500 places each."""
    ppigrf = importlib.import_module("ppigrf")
    dates = _times(version, 20, 3).astype("datetime64[us]")
    r_km = _places_km(POINTS, 4)
    radius_km, theta_deg, phi_deg, axes = _spherical(r_km)
    model = Igrf(version, max_degree)
    for date, rows in zip(dates, np.array_split(np.arange(POINTS), len(dates)), strict=True):
        when: datetime = date.item()
        want_nt = ppigrf.igrf_gc(
            radius_km[rows], theta_deg[rows], phi_deg[rows], when,
            coeff_fn=f"{shc_folder}/IGRF{version}.shc", max_degree=max_degree,
        )  # fmt: skip
        field_nt = model.field_itrf_nt(np.full(len(rows), date), r_km[rows])
        got_nt = np.matvec(axes[rows], field_nt)
        np.testing.assert_allclose(got_nt, np.stack(want_nt, -1)[0], rtol=0, atol=1e-3)


def test_dekart_case_has_the_field_along_the_orbit() -> None:
    """Worked case of the DEKART orbit at t = 10800 s and 86400 s, IGRF-13, printed to 0.001 nT; ITRF from GCRF."""
    from magcal_core.orbit.earth.frames import gcrf_to_itrf

    t_utc = np.datetime64("2022-02-19T22:37:44.130", "ns") + np.array([10800, 86400]).astype("timedelta64[s]")
    r_gcrf_km = np.array([[5042.935447, -28.540182, -4748.761412], [6714.603571, -985.689071, 1381.499114]])
    field_nt = Igrf(13).field_itrf_nt(t_utc, gcrf_to_itrf(t_utc, r_gcrf_km))
    np.testing.assert_allclose(np.linalg.norm(field_nt, axis=1), [41773.121, 25847.035], rtol=0, atol=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_poles_are_finite_and_continuous(sign: float) -> None:
    """1 m from the pole the field differs by less than a gradient of 30 nT/km allows."""
    r_km = np.array([[0.0, 0.0, sign * 6900.0], [0.001, 0.0, sign * 6900.0], [0.0, -0.001, sign * 6900.0]])
    field_nt = Igrf().field_itrf_nt(np.full(3, np.datetime64("2022-01-01", "ns")), r_km)
    assert np.isfinite(field_nt).all()
    np.testing.assert_allclose(field_nt, np.broadcast_to(field_nt[0], (3, 3)), rtol=0, atol=0.03)


@pytest.mark.parametrize("n", [1, 63, 64, 65, 1000, 60_000])
def test_a_samples_field_does_not_depend_on_its_neighbours(n: int) -> None:
    """Blocks, threads and the sorting by interval change nothing, bit for bit."""
    t_utc, r_km = _times(14, n, 5) if n > 1 else _times(14, 2, 5)[:1], _places_km(max(n, 400), 6)[:n]
    together = Igrf().field_itrf_nt(t_utc, r_km)
    some = np.linspace(0, n - 1, min(n, 50)).astype(int)
    alone = np.concatenate([Igrf().field_itrf_nt(t_utc[i : i + 1], r_km[i : i + 1]) for i in some])
    np.testing.assert_array_equal(together[some], alone)


def test_arrays_of_any_order_are_read_and_left_alone() -> None:
    t_utc, r_km = _times(14, 500, 7), _places_km(500, 8)
    want_nt = Igrf().field_itrf_nt(t_utc, r_km)
    fortran = np.asfortranarray(r_km)
    fortran.setflags(write=False)
    t_utc.setflags(write=False)
    np.testing.assert_array_equal(Igrf().field_itrf_nt(t_utc, fortran), want_nt)
    np.testing.assert_array_equal(Igrf().field_itrf_nt(t_utc[::-1], r_km[::-1]), want_nt[::-1])


def test_field_of_a_potential_has_no_divergence_and_no_curl() -> None:
    """Central differences over 1 km: the sixth digit of a gradient of 30 nT/km is the truncation."""
    when = np.datetime64("2022-04-07T21:42:49", "ns")
    centre_km, step_km = np.array([3000.0, -5000.0, 3500.0]), 0.5
    steps = np.vstack([np.eye(3) * step_km, -np.eye(3) * step_km])
    field_nt = Igrf().field_itrf_nt(np.full(6, when), centre_km + steps)
    gradient = (field_nt[:3] - field_nt[3:]) / (2 * step_km)
    assert abs(np.trace(gradient)) < 1e-5
    np.testing.assert_allclose(gradient, gradient.T, rtol=0, atol=1e-5)


def test_frozen_epoch_is_the_field_of_that_instant_at_any_time() -> None:
    r_km = _places_km(400, 9)[:10]
    epoch = np.datetime64("2020-01-01", "ns")
    frozen = Igrf(13, 9, epoch)
    later = np.full(10, np.datetime64("2040-06-01", "ns"))
    np.testing.assert_allclose(
        frozen.field_itrf_nt(later, r_km), Igrf(13, 9).field_itrf_nt(np.full(10, epoch), r_km), rtol=0, atol=1e-9
    )
    assert frozen.name == "igrf-13-9x9@2020-01-01"
    with pytest.raises(ModelRangeError, match="valid from 1900-01-01 to 2025-01-01"):
        Igrf(13, 9, np.datetime64("2026-01-01", "ns"))


@pytest.mark.parametrize(
    ("version", "when"),
    [
        (14, "1899-12-31T23:59:59.999"),
        (14, "2030-01-01T00:00:00.001"),
        (13, "2025-01-01T00:00:00.001"),
        (14, "2100-01-01"),
    ],
)
def test_times_outside_the_validity_are_refused(version: int, when: str) -> None:
    with pytest.raises(ModelRangeError, match=f"valid from 1900-01-01 to {UNTIL[version]}"):
        Igrf(version).field_itrf_nt(np.array([when], "datetime64[ns]"), np.array([[6900.0, 0.0, 0.0]]))


@pytest.mark.parametrize(
    "place_km", [(0.0, 0.0, 0.0), (5871.2, 0.0, 0.0), (np.nan, 0.0, 6900.0), (42164.0, 0.0, 0.0), (np.inf, 0.0, 0.0)]
)
def test_places_where_the_model_says_nothing_are_refused(place_km: tuple[float, float, float]) -> None:
    r_km = np.full((100, 3), 6900.0 / np.sqrt(3))
    r_km[70] = place_km
    with pytest.raises(ModelRangeError, match="sample 70"):
        Igrf().field_itrf_nt(np.full(100, np.datetime64("2022-01-01", "ns")), r_km)


def test_the_ground_is_inside() -> None:
    r_km = np.array([[6378.137, 0.0, 0.0], [0.0, 0.0, 6356.752]])
    assert np.isfinite(Igrf().field_itrf_nt(np.full(2, np.datetime64("2022-01-01", "ns")), r_km)).all()


def test_wrong_versions_degrees_shapes_and_times_are_refused() -> None:
    r_km, when = np.full((2, 3), 4000.0), np.full(2, np.datetime64("2022-01-01", "ns"))
    with pytest.raises(ModelRangeError, match="IGRF-12 is not known"):
        Igrf(12)
    with pytest.raises(ModelRangeError, match="max_degree is 14"):
        Igrf(14, 14)
    with pytest.raises(ModelRangeError, match=r"\(2, 3\)"):
        Igrf().field_itrf_nt(when, r_km[:1])
    with pytest.raises(TimeError, match="NaT"):
        Igrf().field_itrf_nt(np.array(["NaT", "2022"], "datetime64[ns]"), r_km)


def test_no_samples_give_no_field() -> None:
    assert Igrf().field_itrf_nt(np.zeros(0, "datetime64[ns]"), np.zeros((0, 3))).shape == (0, 3)

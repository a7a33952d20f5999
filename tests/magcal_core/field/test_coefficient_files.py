"""Coefficient files: worked vectors, chaosmagpy and pygeomag as other implementations, and what must be refused."""

import csv
import importlib
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.errors import FieldFileError, InputError, ModelRangeError, OptionError
from magcal_core.field.coefficient_files import read_field_file

DATA = Path(__file__).resolve().parents[2] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())


def vectors(name):
    with (DATA / name).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    t_utc = np.array([row["time"].rstrip("Z") for row in rows], "datetime64[ns]")
    places, total = (
        np.array([[float(row[f"{prefix}{axis}{suffix}"]) for axis in "xyz"] for row in rows])
        for prefix, suffix in (("", "_km"), ("total_", "_nt"))
    )
    return t_utc, places, total


def wmmhr():
    folder = Path(str(importlib.import_module("pygeomag").__file__)).parent
    return folder / "wmm" / "WMMHR_2025.COF"


@pytest.mark.parametrize("case", [*CASES["files"], *CASES["high"]], ids=lambda case: case["vectors"])
def test_worked_vectors_and_no_sample_depends_on_its_neighbours(case):
    t_utc, places, total = vectors(case["vectors"])
    file = read_field_file(DATA / case["field_file"] if "field_file" in case else wmmhr())
    if "sha256" in case:
        assert file.sha256 == case["sha256"]
    model = mc.field_model(case["model"], field_file=file)
    found = model.field_itrf_nt(t_utc, places)
    np.testing.assert_allclose(found, total, rtol=0, atol=case["tolerance_nt"])
    assert model.name == case["model"]
    order = np.random.default_rng(1).permutation(len(t_utc))
    np.testing.assert_array_equal(model.field_itrf_nt(t_utc[order], places[order]), found[order])
    np.testing.assert_array_equal(model.field_itrf_nt(t_utc[3:4], places[3:4]), found[3:4])
    for name in ("order", "valid_from", "valid_until"):
        if name in case:
            assert str(getattr(file, name)).startswith(str(case[name]))


@pytest.mark.parametrize("case", CASES["file_refusals"], ids=lambda case: case["file"])
def test_bad_files_are_refused_with_their_code(case):
    with pytest.raises(InputError) as caught:
        mc.read_field_file(DATA / case["file"])
    assert caught.value.code == case["code"]


@pytest.mark.parametrize("case", CASES["file_ranges"], ids=lambda case: case["time"])
def test_beyond_its_validity_a_file_is_model_range(case):
    model = mc.field_model("file", field_file=DATA / case["field_file"])
    with pytest.raises(ModelRangeError, match="valid from"):
        model.field_itrf_nt(np.array([case["time"][:-1]], "datetime64[ns]"), np.array([[6900.0, 0.0, 0.0]]))


def test_the_ends_of_validity_are_included():
    model = mc.field_model("file", field_file=DATA / "model.cof")
    ends = np.array(["2025-01-01", "2030-01-01"], "datetime64[ns]")
    assert np.isfinite(model.field_itrf_nt(ends, np.full((2, 3), 4000.0))).all()


def chaos():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module("chaosmagpy")


def places_about_the_earth(n):
    random = np.random.default_rng(7)
    direction = random.normal(size=(n, 3))
    # Within 0.4 km of both poles: nothing may be divided by the distance from the axis.
    direction[:20] = [[3e-5 * a, 4e-5 * b, c] for a, b, c in random.choice([-1.0, 1.0], size=(20, 3))]
    radius = random.uniform(6671.2, 7371.2, n)
    return direction * (radius / np.linalg.norm(direction, axis=1))[:, None]


@pytest.mark.parametrize("degree", [13, 20, 60, 133])
def test_high_degrees_are_those_of_chaosmagpy(degree):
    """Static coefficients of a random field with the crust's spectrum: 1e-6 nT, poles included."""
    random = np.random.default_rng(degree)
    rows, flat = [], []
    for n in range(1, degree + 1):
        size = 30000.0 * 0.3 ** (n - 1) if n < 10 else 3.0
        for m in [0] + [sign * k for k in range(1, n + 1) for sign in (1, -1)]:
            flat.append(random.normal() * size)
            rows.append(f"{n} {m} {flat[-1]:.10f}")
    text = "\n".join([f"1 {degree} 1 1 0", "2020.0", *rows])
    model = mc.field_model("file", field_file=text.encode())
    places = places_about_the_earth(60)
    radius = np.linalg.norm(places, axis=1)
    theta = np.degrees(np.arctan2(np.hypot(places[:, 0], places[:, 1]), places[:, 2]))
    phi = np.degrees(np.arctan2(places[:, 1], places[:, 0]))
    coefficients = np.round(flat, 10)
    b_r, b_t, b_p = chaos().model_utils.synth_values(coefficients, radius, theta, phi)
    t, p = np.radians(theta), np.radians(phi)
    want = np.stack(
        [
            (b_r * np.sin(t) + b_t * np.cos(t)) * np.cos(p) - b_p * np.sin(p),
            (b_r * np.sin(t) + b_t * np.cos(t)) * np.sin(p) + b_p * np.cos(p),
            b_r * np.cos(t) - b_t * np.sin(t),
        ],
        axis=1,
    )
    found = model.field_itrf_nt(np.full(60, np.datetime64("1950-01-01", "ns")), places)
    np.testing.assert_allclose(found, want, rtol=0, atol=1e-6)


def test_wmmhr_is_that_of_pygeomag():
    """Degree 133 with secular variation, geocentric components at 20 places: 2e-6 nT, as pygeomag's own rounding."""
    pygeomag = importlib.import_module("pygeomag")
    reference = pygeomag.GeoMag(coefficients_file=str(wmmhr()), high_resolution=True)
    model = mc.field_model("file", field_file=wmmhr())
    random = np.random.default_rng(2)
    for _ in range(20):
        lat, lon, height = random.uniform(-89, 89), random.uniform(-180, 180), random.uniform(0, 600)
        got = reference.calculate(glat=lat, glon=lon, alt=height, time=2027.5, allow_date_outside_lifespan=False)
        sin, cos = np.sin(np.radians(lat)), np.cos(np.radians(lat))
        a, b = 6378.137, 6356.7523142
        prime = a * a / np.sqrt((a * cos) ** 2 + (b * sin) ** 2)
        rho, z = (prime + height) * cos, (b * b / (a * a) * prime + height) * sin
        east = np.radians(lon)
        place = np.array([[rho * np.cos(east), rho * np.sin(east), z]])
        start, end = (np.datetime64(f"{year}-01-01", "ns") for year in (2027, 2028))
        x, y, z_nt = model.field_itrf_nt(np.array([start + (end - start) // 2]), place)[0]
        outward = x * np.cos(east) + y * np.sin(east)
        north, down = -sin * outward + cos * z_nt, -cos * outward - sin * z_nt
        np.testing.assert_allclose(
            [north, -x * np.sin(east) + y * np.cos(east), down], [got.x, got.y, got.z], atol=2e-6
        )


@pytest.mark.parametrize("degree", [1, 2, 250])
def test_degrees_to_250_are_finite_and_those_beyond_are_refused(degree):
    rows = [f"{degree} {m} 1.0" for m in range(-degree, degree + 1)]
    text = "\n".join([f"{degree} {degree} 1 1 0", "2020.0", *rows])
    model = mc.field_model("file", field_file=text.encode())
    found = model.field_itrf_nt(np.full(60, np.datetime64("2020-01-01", "ns")), places_about_the_earth(60))
    assert np.isfinite(found).all()
    assert np.abs(found).max() > 0
    with pytest.raises(FieldFileError, match="251"):
        mc.read_field_file(b"1 251 1 1 0\n2020.0\n1 0 1\n")


def dipole(values, order=2, step=1, times="2020.0 2021.0", comment=""):
    rows = [f"1 {m} {values}" for m in (0, 1, -1)]
    return "\n".join([*([f"# {comment}"] if comment else []), f"1 1 {len(times.split())} {order} {step}", times, *rows])


def test_constants_hold_until_the_next_time_and_lines_between():
    place = np.array([[7000.0, 0.0, 0.0]])

    def at(text, when):
        model = mc.field_model("file", field_file=text.encode())
        return model.field_itrf_nt(np.array([when], "datetime64[ns]"), place)[0, 2]

    constant, line = dipole("10 20", 1, 1), dipole("10 20")
    first, second = at(constant, "2020-01-01"), at(constant, "2021-01-01")
    assert second == pytest.approx(2 * first)
    assert at(constant, "2020-12-31T23:00") == first
    assert at(line, "2020-07-02") == pytest.approx(1.5 * first, rel=1e-9)  # 2020 has 366 days
    other = dipole("10 20", comment="decimal years format (False): 365.25 days")
    assert at(other, "2020-07-02") != at(line, "2020-07-02")
    assert at(other, "2020-07-01T15:00") == pytest.approx(1.5 * first, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (dipole("1 2").replace("1 -1", "1 1"), "twice"),
        (dipole("1 2").rpartition("\n")[0], "missing"),
        (dipole("1 nan"), "not a number"),
        (dipole("1"), "1 values for 2 times"),
        (dipole("1 2", times="2021.0 2020.0"), "do not ascend"),
        (dipole("1 2", order=2, step=2), "step 2"),
        ("<html>", "known formats"),
        ("", "known formats"),
        ("2025.0 X 1/1/2025\n1 0 1 0 0 0\n1 1 1 1 0 0\n", "line of 9s"),
        ("2025.0 X 1/1/2025\n1 0 1 0 0 0\n1 1 1 x 0 0\n9999\n", "not a number"),
    ],
)
def test_wrong_files_are_refused_with_the_reason(text, why):
    with pytest.raises(FieldFileError, match=why):
        mc.read_field_file(text.encode())


def test_names_say_which_degrees_a_file_gives():
    file = mc.read_field_file(DATA / "model.cof")
    assert mc.field_model("igrf+file-16x16", field_file=file).name == "igrf-14+file-16x16"
    assert mc.field_model("igrf-14+file", 16, field_file=file).name == "igrf-14+file-16x16"
    assert mc.field_model("file-9x9+mean", field_file=file).name == "file-9x9+mean"
    for name in ("igrf-14-9x9+file", "igrf-14@2020-01-01+file", "igrf-14", "dipole+file"):
        with pytest.raises(OptionError):
            mc.field_model(name, field_file=file)
    with pytest.raises(OptionError, match="needs a file"):
        mc.field_model("igrf-14+file")
    with pytest.raises(ModelRangeError, match="want 1 to 18"):
        mc.field_model("file-19x19", field_file=file)

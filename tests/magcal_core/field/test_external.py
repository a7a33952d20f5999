"""The external field: worked vectors, CHAOS-7's magnetosphere, its potential, gaps, corners, and considered errors."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.errors import IndexMissingError, IndexRangeError, InputError, ModelRangeError, OptionError
from magcal_core.field.external import GAIN, UNIFORM_NT, geomagnetic_axis, shapes
from magcal_core.field.external_knowledge import ExternalKnowledge
from magcal_core.field.sources import FieldSources
from magcal_core.reference.field_along_orbit import Stretches, field_along
from magcal_core.simulation.missions import draw_orbit

DATA = Path(__file__).resolve().parents[2] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())
STORM = np.datetime64("2024-05-10T12:00", "ns")


def columns(name, *prefixes):
    with (DATA / name).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    t_utc = np.array([row["time"].rstrip("Z") for row in rows], "datetime64[ns]")
    found = [np.array([[float(row[p.format(axis)]) for axis in "xyz"] for row in rows]) for p in prefixes]
    return t_utc, *found


@pytest.fixture(scope="module")
def storm_index():
    return mc.read_index(DATA / "rc_2024-05.dat")


@pytest.mark.parametrize("case", CASES["field"], ids=lambda case: case["file"])
def test_worked_vectors_and_no_sample_depends_on_its_neighbours(case):
    t_utc, places, external, total = columns(case["file"], "{}_km", "ext_{}_nt", "total_{}_nt")
    model = mc.field_model(case["model"], index=None if case["index"] is None else DATA / case["index"])
    found = model.field_itrf_nt(t_utc, places)
    np.testing.assert_allclose(found, total, rtol=0, atol=case["tolerance_nt"])
    np.testing.assert_allclose(found - mc.Igrf().field_itrf_nt(t_utc, places), external, rtol=0, atol=1e-6)
    assert model.name == case["model"]
    order = np.random.default_rng(1).permutation(len(t_utc))
    np.testing.assert_array_equal(model.field_itrf_nt(t_utc[order], places[order]), found[order])
    one = [model.field_itrf_nt(t_utc[i : i + 1], places[i : i + 1])[0] for i in range(len(t_utc))]
    np.testing.assert_array_equal(one, found)


@pytest.mark.parametrize(
    "case", [case for case in CASES["field"] if "chaos_limit_nt" in case], ids=lambda case: case["file"]
)
def test_it_is_within_4_nt_of_the_magnetosphere_of_chaos(case):
    """Vectors of CHAOS-7 (chaosmagpy 0.16, SM and GSM sources with induction): rms of a component."""
    t_utc, places, chaos = columns(case["file"], "{}_km", "chaos_{}_nt")
    model = mc.field_model(case["model"], index=DATA / case["index"])
    away = model.field_itrf_nt(t_utc, places) - mc.Igrf().field_itrf_nt(t_utc, places) - chaos
    assert np.sqrt(np.mean(away**2)) <= case["chaos_limit_nt"]


def test_it_is_the_gradient_of_its_potential(storm_index):
    """V = -a [(G e - U)(r/a) + G i (a/r)^2] cos(theta), by central differences over 10 m: 1e-5 nT."""
    when = np.array(["2024-05-11T02:30"], "datetime64[ns]")  # the middle of an hour: a value of the file
    row = list(storm_index.start_ns).index(int(np.datetime64("2024-05-11T02:00", "ns").astype(np.int64)))
    e, i = storm_index.external_nt[row], storm_index.induced_nt[row]
    axis = geomagnetic_axis(when.astype(np.int64))[0]

    def potential(r_km):
        radius = np.linalg.norm(r_km)
        cos = axis @ r_km / radius
        return -6371.2 * ((GAIN * e - UNIFORM_NT) * radius / 6371.2 + GAIN * i * (6371.2 / radius) ** 2) * cos

    place, step = np.array([4000.0, -5000.0, 3000.0]), 0.01
    want = [-(potential(place + d) - potential(place - d)) / (2 * step) for d in step * np.eye(3)]
    model = mc.field_model("igrf-14+rc", index=storm_index)
    found = model.field_itrf_nt(when, place[None]) - mc.Igrf().field_itrf_nt(when, place[None])
    np.testing.assert_allclose(found[0], want, atol=1e-5)


@pytest.mark.parametrize("case", CASES["ranges"], ids=lambda case: case["index"])
def test_beyond_the_index_is_index_range_with_its_span(case):
    model = mc.field_model(case["model"], index=DATA / case["index"])
    with pytest.raises(InputError, match="2024-05-07T00:00:00Z to 2024-05-14T00:00:00Z") as caught:
        model.field_itrf_nt(np.array([case["time"][:-1]], "datetime64[ns]"), np.array([case["position_km"]]))
    assert caught.value.code == case["code"]


def hours(*rows, name="rc_nt"):
    return mc.read_index("\n".join([f"hour,{name}", *(f"2024-05-11T{h:02d}:00:00Z,{v}" for h, v in rows)]).encode())


def field_at(index, *times, gap="refuse"):
    t_utc = np.array([f"2024-05-11T{time}" for time in times], "datetime64[ns]")
    places = np.tile([[0.0, 7000.0, 0.0]], (len(times), 1))
    model = mc.field_model("igrf-14+rc", index=index, index_gap=gap)
    return model.field_itrf_nt(t_utc, places) - mc.Igrf().field_itrf_nt(t_utc, places)


def test_values_stand_at_middles_and_ends_are_constant_for_half_an_hour():
    index = mc.read_index(
        b"hour,rc_external_nt,rc_induced_nt\n2024-05-11T01:00:00Z,-10,0\n2024-05-11T02:00:00Z,-30,0\n"
    )
    first, middle, between, last, end = field_at(index, "01:00", "01:30", "02:00", "02:30", "02:59:59")
    np.testing.assert_allclose(first, middle, atol=1e-4)
    np.testing.assert_allclose(2 * between, middle + last, atol=1e-4)
    np.testing.assert_allclose(end, last, atol=1e-4)
    for outside in ("00:59:59", "03:00"):
        with pytest.raises(IndexRangeError):
            field_at(index, outside)


def test_a_gap_of_three_hours_is_bridged_and_one_of_four_refused_or_the_mean():
    three, four = hours((0, -10), (4, -50)), hours((0, -10), (5, -50))
    field_at(three, "01:30", "02:30", "03:30")
    with pytest.raises(IndexRangeError, match="1 of 2 samples"):
        field_at(four, "00:45", "02:30")
    mean = field_at(four, "02:30", gap="mean")[0]
    when, place = np.array(["2024-05-11T02:30"], "datetime64[ns]"), np.array([[0.0, 7000.0, 0.0]])
    want = mc.field_model("igrf-14+mean").field_itrf_nt(when, place) - mc.Igrf().field_itrf_nt(when, place)
    np.testing.assert_allclose(mean, want[0], atol=1e-9)


def test_names_need_their_index_and_an_external_field_ends_at_two_radii(storm_index):
    for name in ("igrf-14+rc", "igrf-14+dst"):
        with pytest.raises(IndexMissingError):
            mc.field_model(name, index=DATA / "kp_2024-05.txt")
    with pytest.raises(OptionError, match="index_gap"):
        mc.field_model("igrf-14+rc", index=storm_index, index_gap="hold")
    model = mc.field_model("igrf-14+rc", index=storm_index)
    when = np.array(["2024-05-11T02:30"], "datetime64[ns]")
    assert np.isfinite(model.field_itrf_nt(when, np.array([[12742.0, 0.0, 0.0]]))).all()
    with pytest.raises(ModelRangeError, match="12742 km"):
        model.field_itrf_nt(when, np.array([[12743.0, 0.0, 0.0]]))
    with pytest.raises(ModelRangeError, match="6350"):
        model.field_itrf_nt(when, np.array([[6300.0, 0.0, 0.0]]))


@pytest.mark.parametrize("is_gcrf", [False, True])
@pytest.mark.parametrize("uses", [1, 4])
def test_polynomials_along_an_orbit_end_at_the_corners_of_the_index(storm_index, is_gcrf, uses):
    """Onset of the storm, changes of 100 nT an hour: 0.01 nT of the field at every sample, no interval given up."""
    orbit = draw_orbit(np.random.default_rng(4), STORM)
    t_utc = STORM + np.arange(0, 10 * 3600, 2).astype("timedelta64[s]")
    model = mc.field_model("igrf-14+rc", index=storm_index)
    along = field_along(orbit, model, t_utc, is_gcrf=False, uses=uses)
    assert isinstance(along.pieces, Stretches)
    assert along.pieces.gap_fraction == 0.0
    at = t_utc if uses == 1 else t_utc + np.timedelta64(700, "ms")
    want = model.field_itrf_nt(at, orbit.position_itrf_km(at))
    np.testing.assert_allclose(along.at(at), want, rtol=0, atol=0.01)
    if is_gcrf:
        turned = field_along(orbit, model, t_utc, is_gcrf=True, uses=uses).at(at)
        np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(want, axis=1), rtol=0, atol=0.01)


def test_considered_errors_have_the_sizes_of_the_table(storm_index):
    t_ns = (STORM + np.arange(0, 3600, 60).astype("timedelta64[s]")).astype(np.int64)
    places = np.tile([[0.0, 6900.0, 0.0]], (len(t_ns), 1))
    dst = mc.read_index(DATA / "dst_2024-05.txt")
    alone = hours(*((h, -60) for h in range(24)))
    alone_ns = t_ns + (np.datetime64("2024-05-11T02", "ns") - STORM).astype(np.int64)

    def sizes(name, index=(), at=t_ns, sources=()):
        field = mc.field_model(name, index=index)
        found = ExternalKnowledge.of(field, FieldSources.of([*index, *sources])).sizes(at)[0]
        return found.ring, found.induced, found.uniform

    assert sizes("igrf-14") == (17.0, 2.5, 23.0)
    assert sizes("igrf-14+mean") == (17.0, 2.5, 3.0)
    largest = ExternalKnowledge.of(mc.field_model("igrf-14+rc", index=storm_index)).to_dict(t_ns, places)["index_nt"]
    size = max(abs(largest["min"]), abs(largest["max"]))
    np.testing.assert_allclose(sizes("igrf-14+rc", [storm_index]), (0.1 * size, 1.0, 2.0))
    np.testing.assert_allclose(sizes("igrf-14+rc", [alone], alone_ns), (6.0, 1.5, 2.0))
    ring, induced, uniform = sizes("igrf-14+dst", [dst])
    assert (ring**2 - 9.0) / 0.01 == pytest.approx((induced**2 - 4.0) / 0.0004)
    assert uniform == 6.0
    beside = sizes("igrf-14", sources=[storm_index])
    rows = storm_index.external_nt[84:86]  # the hours from 12 and 13 h of the 10th
    assert min(abs(rows)) * 0.8 < beside[0] < max(abs(rows)) * 1.3
    assert beside[1:] == (2.5, 23.0)


def test_shapes_are_those_of_a_uniform_and_of_a_dipole_field(storm_index):
    t_ns = np.full(2, STORM.astype(np.int64))
    places = np.array([[0.0, 7000.0, 100.0], [100.0, -300.0, 6800.0]])
    uniform, induced = shapes(t_ns, places)
    errors = ExternalKnowledge.of(mc.Igrf()).errors(t_ns, t_ns, places)
    assert [one.source for one in errors] == ["external_ring", "external_induced", "external_uniform"]
    np.testing.assert_allclose(errors[0].error_nt, 17.0 * (uniform + 0.27 * induced))
    np.testing.assert_allclose(errors[1].error_nt, 2.5 * induced)
    np.testing.assert_allclose(errors[2].error_nt, 23.0 * uniform)
    radius = np.linalg.norm(places, axis=1)
    up = places / radius[:, None]
    along = np.einsum("ij,ij->i", uniform, up)
    np.testing.assert_allclose(np.einsum("ij,ij->i", induced, up), -2 * (6371.2 / radius) ** 3 * along)
    np.testing.assert_allclose(np.linalg.norm(uniform, axis=1), 1.0)


def test_the_mean_of_a_gap_has_the_means_errors():
    index = hours((0, -10), (5, -50))
    model = mc.field_model("igrf-14+rc", index=index, index_gap="mean")
    t_ns = np.array(["2024-05-11T00:10", "2024-05-11T02:30"], "datetime64[ns]").astype(np.int64)
    places = np.tile([[0.0, 7000.0, 0.0]], (2, 1))
    known = ExternalKnowledge.of(model)
    uniform = known.errors(t_ns, t_ns, places)[2].error_nt
    np.testing.assert_allclose(np.linalg.norm(uniform, axis=1), [2.0, 3.0])
    assert known.to_dict(t_ns, places)["mean_samples"] == 1

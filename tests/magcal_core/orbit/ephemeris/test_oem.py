"""Ephemerides: interpolated against the orbit they were made from, and refused where they say nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.errors import ModelRangeError, OrbitFormatError
from magcal_core.orbit.earth.frames import Frame, convert_state
from magcal_core.orbit.ephemeris.oem import parse_oem
from magcal_core.orbit.messages.state import state_from_mapping
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

Floats = NDArray[np.float64]
START = np.datetime64("2022-02-19T22:37:44.130", "ns")
NUMERICAL = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "GCRF",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}


@pytest.fixture(scope="module")
def circle() -> tuple[NDArray[np.datetime64], Floats, Floats]:
    """A Kepler circle in GCRF, 60 s apart over 100 min: a closed form."""
    state = state_from_mapping(NUMERICAL)
    return _circle(START + (np.arange(101) * 60).astype("timedelta64[s]"), state.r_km)


def _circle(t_utc: NDArray[np.datetime64], r_km: Floats) -> tuple[NDArray[np.datetime64], Floats, Floats]:
    radius_km = float(np.linalg.norm(r_km))
    rate = np.sqrt(398600.4415 / radius_km**3)
    along = np.array([0.0, 0.6, 0.8]) - r_km * (np.array([0.0, 0.6, 0.8]) @ r_km) / radius_km**2
    along /= np.linalg.norm(along)
    angle = rate * ((t_utc - START) / np.timedelta64(1, "ns"))[:, None] / 1e9
    return (
        t_utc,
        np.cos(angle) * r_km + np.sin(angle) * radius_km * along,
        rate * (np.cos(angle) * radius_km * along - np.sin(angle) * r_km),
    )


def _oem(t_utc: NDArray[np.datetime64], r_km: Floats, v_km_s: Floats, meta: dict[str, str] | None = None) -> str:
    stamps = [str(t)[:26] for t in t_utc]
    keys = {
        "OBJECT_NAME": "DEKART", "OBJECT_ID": "2020-068H", "CENTER_NAME": "EARTH", "REF_FRAME": "GCRF",
        "TIME_SYSTEM": "UTC", "START_TIME": stamps[0], "STOP_TIME": stamps[-1],
        "INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "7",
    }  # fmt: skip
    lines = [
        "META_START",
        *(f"{key} = {value}" for key, value in (keys | (meta or {})).items() if value),
        "META_STOP",
        "COMMENT x",
    ]
    lines += [f"{t} " + " ".join(f"{c:.12f}" for c in (*r, *v)) for t, r, v in zip(stamps, r_km, v_km_s, strict=True)]
    lines += ["COVARIANCE_START", "EPOCH = 2022-02-19T22:37:44", "1.0", "0.0 1.0", "COVARIANCE_STOP"]
    return "\n".join(lines) + "\n"


HEADER = "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2022-02-20T00:00:00\nORIGINATOR = TEST\n"


@pytest.mark.parametrize(
    ("meta", "atol_km"),
    [
        ({}, 1e-8),
        ({"INTERPOLATION_DEGREE": "5"}, 1e-5),
        ({"INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": "9"}, 1e-6),
        ({"INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": "8"}, 1e-5),
        ({"INTERPOLATION": "", "INTERPOLATION_DEGREE": ""}, 1e-8),
    ],
)
def test_interpolation_is_the_one_that_the_message_names(
    meta: dict[str, str], atol_km: float, circle: tuple[NDArray[np.datetime64], Floats, Floats]
) -> None:
    """Against the closed form between the nodes and at the edges; each tolerance is its order's error over 60 s."""
    orbit = parse_oem(HEADER + _oem(*circle, meta))
    t_utc = START + (np.linspace(0.0, 6000.0, 733) * 1e9).astype("timedelta64[ns]")
    _, want_km, want_km_s = _circle(t_utc, circle[1][0])
    r_km, v_km_s = orbit.state_gcrf(t_utc)
    np.testing.assert_allclose(r_km, want_km, rtol=0, atol=atol_km)
    np.testing.assert_allclose(v_km_s, want_km_s, rtol=0, atol=max(atol_km * 3e-3, 1e-10))


def test_linear_interpolation_is_as_bad_as_it_says_where_the_velocities_do_not_allow_better(
    circle: tuple[NDArray[np.datetime64], Floats, Floats],
) -> None:
    """Over 60 s the chord of a low orbit is 3.8 km from it; with velocities it is done better."""
    meta = {"INTERPOLATION": "LINEAR", "INTERPOLATION_DEGREE": ""}
    t_utc = START + (np.linspace(0.0, 6000.0, 733) * 1e9).astype("timedelta64[ns]")
    _, want_km, _ = _circle(t_utc, circle[1][0])
    plain = parse_oem(HEADER + _oem(circle[0], circle[1], 0.0 * circle[2], meta))
    assert 3.0 < np.linalg.norm(plain.state_gcrf(t_utc)[0] - want_km, axis=1).max() < 4.0
    better = parse_oem(HEADER + _oem(*circle, meta))
    np.testing.assert_allclose(better.state_gcrf(t_utc)[0], want_km, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "frame"), [("EME2000", "EME2000"), ("TEME", "TEME"), ("ITRF2014", "ITRF"), ("ICRF", "GCRF")]
)
def test_frames_are_turned_to_gcrf_and_itrf(
    name: str, frame: Frame, circle: tuple[NDArray[np.datetime64], Floats, Floats]
) -> None:
    """TEME turns a little against the stars, so velocities in it are not quite slopes: 2 mm at the edges."""
    t_utc, r_km, v_km_s = circle
    orbit = parse_oem(HEADER + _oem(t_utc, *convert_state(t_utc, r_km, v_km_s, "GCRF", frame), {"REF_FRAME": name}))
    between = START + (np.arange(30, 6000, 60)).astype("timedelta64[s]")
    _, want_km, want_km_s = _circle(between, r_km[0])
    found_km, found_km_s = orbit.state_gcrf(between)
    np.testing.assert_allclose(found_km, want_km, rtol=0, atol=5e-6)
    np.testing.assert_allclose(found_km_s, want_km_s, rtol=0, atol=1e-7)
    in_itrf = convert_state(between, want_km, want_km_s, "GCRF", "ITRF")[0]
    np.testing.assert_allclose(orbit.position_itrf_km(between), in_itrf, rtol=0, atol=5e-6)


@pytest.mark.parametrize(
    ("system", "ahead_s"), [("UTC", 0.0), ("TAI", 37.0), ("GPS", 18.0), ("TT", 69.184), ("TDB", 69.1848)]
)
def test_time_systems_are_turned_to_utc(
    system: str, ahead_s: float, circle: tuple[NDArray[np.datetime64], Floats, Floats]
) -> None:
    """TAI - UTC = 37 s since 2017; TDB is within 2 ms of TT, and the sixth digit of the text rounds to 1 us."""
    ahead = np.timedelta64(round(ahead_s * 1e9), "ns")
    orbit = parse_oem(HEADER + _oem(circle[0] + ahead, *circle[1:], {"TIME_SYSTEM": system}))
    apart = abs(orbit.epoch_utc - START)
    assert apart < np.timedelta64(2_000_000 if system == "TDB" else 2, "ns")


def test_outside_its_segments_there_is_no_position(circle: tuple[NDArray[np.datetime64], Floats, Floats]) -> None:
    t_utc, r_km, v_km_s = circle
    useable = str(t_utc[10])[:26]
    text = HEADER + _oem(t_utc[:50], r_km[:50], v_km_s[:50], {"USEABLE_START_TIME": useable})
    orbit = parse_oem(text + _oem(t_utc[60:], r_km[60:], v_km_s[60:]))
    asked = t_utc[[9, 10, 49, 55, 60, 100]] + np.array([0, 0, 0, 0, 0, 0], "timedelta64[ns]")
    np.testing.assert_array_equal(orbit.covers(asked), [False, True, True, False, True, True])
    assert (orbit.epoch_utc, orbit.until_utc) == (t_utc[10], t_utc[100])
    for outside in (asked[0], asked[3], t_utc[100] + np.timedelta64(1, "ms")):
        with pytest.raises(ModelRangeError, match="the ephemeris has no position at"):
            orbit.position_itrf_km(np.array([outside]))
    np.testing.assert_allclose(orbit.state_gcrf(asked[[1, 2, 4, 5]])[0], r_km[[10, 49, 60, 100]], rtol=0, atol=1e-9)


def test_interpolation_never_reaches_across_segments(circle: tuple[NDArray[np.datetime64], Floats, Floats]) -> None:
    """After a manoeuvre the second segment is another orbit: the first must not feel it."""
    t_utc, r_km, v_km_s = circle
    text = HEADER + _oem(t_utc[:51], r_km[:51], v_km_s[:51]) + _oem(t_utc[50:], 1.1 * r_km[50:], 1.1 * v_km_s[50:])
    before = t_utc[49:50] + np.timedelta64(59_999, "ms")
    _, want_km, _ = _circle(before, r_km[0])
    np.testing.assert_allclose(parse_oem(text).state_gcrf(before)[0], want_km, rtol=0, atol=1e-7)


def test_xml_and_kvn_are_the_same_ephemeris(circle: tuple[NDArray[np.datetime64], Floats, Floats]) -> None:
    names = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
    kvn = HEADER + _oem(*circle)
    meta = dict(line.split(" = ") for line in kvn.splitlines()[4:13])
    rows = [line.split() for line in kvn.splitlines() if line.startswith("2022")]
    vectors = "".join(
        "<stateVector>" + "".join(f"<{n}>{c}</{n}>" for n, c in zip(names, row, strict=True)) + "</stateVector>"
        for row in rows
    )
    tags = "".join(f"<{key}>{value}</{key}>" for key, value in meta.items())
    xml = f'<?xml version="1.0"?><oem id="CCSDS_OEM_VERS" version="2.0"><body><segment><metadata>{tags}</metadata>'
    xml += f"<data>{vectors}</data></segment></body></oem>"
    t_utc = circle[0][:-1] + np.timedelta64(17, "s")
    for one, two in zip(parse_oem(xml).state_gcrf(t_utc), parse_oem(kvn).state_gcrf(t_utc), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("REF_FRAME = GCRF", "REF_FRAME = MOON_ME", "segment 1, REF_FRAME"),
        ("REF_FRAME = GCRF\n", "", "segment 1, REF_FRAME"),
        ("TIME_SYSTEM = UTC", "TIME_SYSTEM = MET", "segment 1, TIME_SYSTEM"),
        ("CENTER_NAME = EARTH", "CENTER_NAME = MARS", "segment 1, CENTER_NAME"),
        ("INTERPOLATION = HERMITE", "INTERPOLATION = SPLINE", "segment 1, INTERPOLATION"),
        ("INTERPOLATION_DEGREE = 7", "INTERPOLATION_DEGREE = -1", "segment 1, INTERPOLATION_DEGREE"),
        ("START_TIME = 2022-02-19", "START_TIME = 2022-99-99", "segment 1, START_TIME"),
        ("2022-02-19T22:38:44.130000 ", "2022-02-19T22:36:44.130000 ", "line 17"),
        ("2022-02-19T22:38:44.130000 ", "2022-02-19T22:38:44.130000 nan ", "line 17"),
        ("2022-02-19T22:38:44.130000 ", "2022-02-19T22:38:44.130000 x ", "line 17"),
        ("2022-02-19T22:38:44.130000 ", "someday ", "line 17"),
        ("META_STOP\n", "", "line 15"),
    ],
)
def test_each_fault_is_named(
    old: str, new: str, where: str, circle: tuple[NDArray[np.datetime64], Floats, Floats]
) -> None:
    text = (HEADER + _oem(*circle)).replace(old, new, 1)
    with pytest.raises(OrbitFormatError) as caught:
        parse_oem(text)
    assert where in [fault.where for fault in caught.value.faults]


def test_too_few_states_for_the_degree_are_refused(circle: tuple[NDArray[np.datetime64], Floats, Floats]) -> None:
    with pytest.raises(OrbitFormatError, match="degree 7 needs 4"):
        parse_oem(HEADER + _oem(circle[0][:3], circle[1][:3], circle[2][:3]))
    with pytest.raises(OrbitFormatError, match="no segment"):
        parse_oem(HEADER)


def test_a_tles_ephemeris_gives_the_tles_positions(data_dir: Path) -> None:
    """SGP4 every 60 s, Lagrange of degree 9: its velocity is not quite the derivative, its positions are smooth."""
    orbit = Sgp4Orbit.from_tle("\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]))
    t_utc = START + (np.arange(200) * 60).astype("timedelta64[s]")
    meta = {"REF_FRAME": "TEME", "INTERPOLATION": "LAGRANGE", "INTERPOLATION_DEGREE": "9"}
    ephemeris = parse_oem(HEADER + _oem(t_utc, *orbit.state_teme(t_utc), meta))
    asked = START + (np.arange(300, 11000, 7)).astype("timedelta64[s]")
    np.testing.assert_allclose(ephemeris.position_itrf_km(asked), orbit.position_itrf_km(asked), rtol=0, atol=1e-6)
    assert json.dumps([ephemeris.name, ephemeris.cospar_id]) == '["DEKART", "2020-068H"]'

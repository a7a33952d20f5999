"""An ephemeris is not believed between its points: how far it is off there is found, mended, told or refused."""

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.errors import ModelRangeError, OrbitFormatError
from magcal_core.field.igrf import Igrf
from magcal_core.numerics.interpolation import StateTable
from magcal_core.orbit.ephemeris.interpolation_check import best_interpolation
from magcal_core.orbit.ephemeris.oem import parse_oem
from magcal_core.reference.columns import with_reference
from magcal_core.reference.error_budget import ReferenceSource, error_budget
from magcal_core.samples import Samples

MU = 398_600.4418
T0 = np.datetime64("2024-05-11T00:00:00", "ns")
Floats = NDArray[np.float64]


def kepler(t_s: Floats, axis_km: float, eccentricity: float) -> tuple[Floats, Floats]:
    """Return the closed form of Kepler's ellipse, positions and velocities, shape (n, 3)."""
    rate = np.sqrt(MU / axis_km**3)
    mean = rate * t_s + 0.3
    anomaly = mean.copy()
    for _ in range(30):
        anomaly -= (anomaly - eccentricity * np.sin(anomaly) - mean) / (1 - eccentricity * np.cos(anomaly))
    minor = axis_km * np.sqrt(1 - eccentricity**2)
    speed = rate / (1 - eccentricity * np.cos(anomaly))
    x, y = axis_km * (np.cos(anomaly) - eccentricity), minor * np.sin(anomaly)
    vx, vy = -axis_km * np.sin(anomaly) * speed, minor * np.cos(anomaly) * speed
    tilt = np.array([[1.0, 0.0], [0.0, np.cos(1.7)], [0.0, np.sin(1.7)]])
    return np.stack([x, y], 1) @ tilt.T, np.stack([vx, vy], 1) @ tilt.T


def oem(
    step_s: int, method: str, degree: int, *, axis_km: float = 6878.0, e: float = 0.002, velocities: str = "own"
) -> str:
    t_s = np.arange(max(28, 16_000 // step_s)) * float(step_s)
    r_km, v_km_s = kepler(t_s, axis_km, e)
    v_km_s = {"own": v_km_s, "none": np.zeros_like(v_km_s), "turned": v_km_s[:, ::-1]}[velocities]
    stamps = [np.datetime_as_string(T0 + np.timedelta64(int(s), "s"), unit="s") for s in t_s]
    head = {
        "CENTER_NAME": "EARTH",
        "REF_FRAME": "GCRF",
        "TIME_SYSTEM": "UTC",
        "START_TIME": stamps[0],
        "STOP_TIME": stamps[-1],
        "INTERPOLATION": method,
        "INTERPOLATION_DEGREE": degree,
    }
    rows = zip(stamps, r_km.tolist(), v_km_s.tolist(), strict=True)
    return "\n".join(
        ["CCSDS_OEM_VERS = 2.0", "META_START", *(f"{k} = {v}" for k, v in head.items()), "META_STOP"]
        + [" ".join([stamp, *map(repr, r + v)]) for stamp, r, v in rows]
    )


def true_error_km(
    text: str, method: str, degree: int, *, axis_km: float = 6878.0, e: float = 0.002
) -> tuple[float, float]:
    """Return how far the orbit is off as it is used, and as the file says, at the most between inner points, km."""
    (segment,) = parse_oem(text.replace(f"= {degree}\n", f"= {degree}\n")).segments
    stamps = segment.table.stamps_ns
    at = np.linspace(stamps[6], stamps[-7], 4001).astype(np.int64)
    true_km, _ = kepler((at - stamps[0]) / 1e9, axis_km, e)
    said = segment.table.hermite(at, degree)[0] if method == "HERMITE" else segment.table.lagrange(at, degree)[0]
    used = segment.state(at)[0]
    return (float(np.linalg.norm(one - true_km, axis=1).max()) for one in (used, said))


EPHEMERIDES = [(900, 5), (600, 5), (300, 3), (60, 1), (180, 5)]
"""Step, s, and degree of Lagrange: 29, 2.8, 2.0, 3.8 km and 2 m off on a circular orbit of 500 km."""


@pytest.mark.parametrize(("step_s", "degree"), EPHEMERIDES)
@pytest.mark.parametrize(("axis_km", "e"), [(6878.0, 0.002), (7178.0, 0.01)])
@pytest.mark.parametrize("velocities", ["own", "none"])
def test_the_error_between_points_is_found_within_20_percent(step_s, degree, axis_km, e, velocities):
    """Against the ellipse's closed form, at 4001 times between inner points; without velocities by points left out."""
    t_s = np.arange(max(28, 16_000 // step_s)) * float(step_s)
    r_km, v_km_s = kepler(t_s, axis_km, e)
    table = StateTable((t_s * 1e9).astype(np.int64), r_km, v_km_s if velocities == "own" else np.zeros_like(v_km_s))
    at = np.linspace(table.stamps_ns[6], table.stamps_ns[-7], 4001).astype(np.int64)
    true_km = np.linalg.norm(table.lagrange(at, degree)[0] - kepler(at / 1e9, axis_km, e)[0], axis=1)
    found = best_interpolation(table, "LAGRANGE", degree)
    # The median over the intervals of the largest error in each.
    interval = np.searchsorted(table.stamps_ns, at, side="right")
    largest = [true_km[interval == i].max() for i in np.unique(interval)[1:-1]]
    assert found.as_said_km == pytest.approx(np.median(largest), rel=0.2)
    if velocities == "none":
        assert found.method == "LAGRANGE"
        assert found.error_km(at).max() == pytest.approx(true_km.max(), rel=0.2)


def test_an_ephemeris_that_is_off_is_interpolated_better_where_its_velocities_allow():
    """900 s with Lagrange 5: 29 km off as the file says, below 5 m by Hermite's polynomial of degree 11."""
    text = oem(900, "LAGRANGE", 5)
    used_km, said_km = true_error_km(text, "LAGRANGE", 5)
    assert said_km > 20.0
    assert used_km < 0.005
    (segment,) = parse_oem(text).segments
    assert (segment.interpolation, segment.degree) == ("HERMITE", 11)


def test_a_sound_ephemeris_is_interpolated_as_it_says():
    (segment,) = parse_oem(oem(60, "LAGRANGE", 7)).segments
    assert (segment.interpolation, segment.degree) == ("LAGRANGE", 7)


@pytest.mark.parametrize("velocities", ["none", "turned"])
def test_beyond_ten_kilometres_an_ephemeris_is_refused_with_its_size(velocities):
    with pytest.raises(
        OrbitFormatError, match=r"interpolation \(LAGRANGE 5\) between its points, 900 s apart, is \d+ km off"
    ):
        parse_oem(oem(900, "LAGRANGE", 5, velocities=velocities))


def samples(orbit, begin_s: float, count: int = 200) -> Samples:
    t_utc = T0 + (np.arange(count) * 20 + int(begin_s)) * np.timedelta64(1, "s")
    return Samples(t_utc=t_utc, h_nt=np.tile([2e4, 1e4, 3e4], (count, 1)))


def test_between_a_third_and_ten_kilometres_a_warning_and_the_budget_name_the_size():
    orbit = parse_oem(oem(600, "LAGRANGE", 5, velocities="none"))
    filled, report = with_reference(samples(orbit, 6000.0), [orbit], Igrf())
    (warning,) = [one for one in report.warnings if one.startswith("orbit_interpolation")]
    assert report.interpolation_km == pytest.approx(2.8, rel=0.2)
    assert f"up to {report.interpolation_km:.2g} km off between its points" in warning
    source = ReferenceSource("oem", 0.0, Igrf(), interpolation_km=report.interpolation_km)
    items = {item.source: item.rms_nt for item in error_budget(filled, source)}
    # 10 to 30 nT/km across and along a polar orbit.
    assert 5.0 < items["orbit_interpolation"] < 60.0
    assert items["total"] >= items["orbit_interpolation"]


def test_where_the_telemetry_meets_the_worse_ends_of_an_ephemeris_it_is_refused():
    """At its ends the polynomial has its points on one side: 13 km off instead of 2.8."""
    orbit = parse_oem(oem(600, "LAGRANGE", 5, velocities="none"))
    with pytest.raises(ModelRangeError, match=r"off between its points at the times of the telemetry; limit 10 km"):
        with_reference(samples(orbit, 0.0), [orbit], Igrf())


def test_a_sound_ephemeris_gives_no_warning():
    orbit = parse_oem(oem(60, "LAGRANGE", 7))
    _, report = with_reference(samples(orbit, 3000.0), [orbit], Igrf())
    assert not [one for one in report.warnings if one.startswith("orbit_interpolation")]
    assert report.interpolation_km < 0.01

"""Osculating elements against the DEKART paper's table, closed forms and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magcal_core.errors import OrbitFormatError
from magcal_core.orbit.messages.elements import OsculatingElements, elements_from_state, state_from_elements

PRINTED = [
    (
        ((6861.897826, -934.3811016, -14.66851920), (-0.1222573311, -1.009655310, 7.525523775)),
        {"a": 6938.52, "e": 0.001918, "u": -0.122, "i": 97.685, "node": -7.769, "perigee": 3.238},
    ),
    (
        ((5387.702395, 4384.530827, -11.64048825), (0.6474313881, -0.7969563504, 7.500478986)),
        {"a": 6937.71, "e": 0.002168, "u": -0.0969, "i": 97.785, "node": 39.1217, "perigee": 124.977},
    ),
]


@pytest.mark.parametrize(("state", "printed"), PRINTED)
def test_dekart_states_have_the_papers_elements(
    state: tuple[tuple[float, ...], tuple[float, ...]], printed: dict[str, float]
) -> None:
    """DEKART: a, e, u to all printed digits; i, node and perigee are misprinted by up to 0.0105, 0.0040, 0.013 deg."""
    found = elements_from_state(*state)
    assert found.semi_major_axis_km == pytest.approx(printed["a"], abs=0.005)
    assert found.eccentricity == pytest.approx(printed["e"], abs=5e-7)
    assert np.degrees(found.argument_of_latitude_rad) == pytest.approx(printed["u"], abs=5e-4)
    assert np.degrees(found.inclination_rad) == pytest.approx(printed["i"], abs=0.012)
    assert np.degrees(found.raan_rad) == pytest.approx(printed["node"], abs=0.0045)
    assert np.degrees(found.argument_of_perigee_rad) == pytest.approx(printed["perigee"], abs=0.015)


ANGLE = st.floats(-3.1, 3.1)


@given(st.tuples(st.floats(6500.0, 50000.0), st.floats(0.0, 0.9), st.floats(0.0, np.pi), ANGLE, ANGLE, ANGLE))
def test_state_comes_back_from_its_elements(values: tuple[float, float, float, float, float, float]) -> None:
    """Circles and equatorial orbits too, where single elements have no meaning but the state has."""
    r_km, v_km_s = state_from_elements(OsculatingElements(*values))
    again = state_from_elements(elements_from_state(r_km, v_km_s))
    np.testing.assert_allclose(again[0], r_km, rtol=0, atol=1e-6)
    np.testing.assert_allclose(again[1], v_km_s, rtol=0, atol=1e-9)


def test_elements_come_back_from_their_state() -> None:
    want = OsculatingElements(7000.0, 0.01, 1.7, -0.4, 2.5, -1.2)
    found = elements_from_state(*state_from_elements(want))
    for name in OsculatingElements.__slots__:
        assert getattr(found, name) == pytest.approx(getattr(want, name), rel=1e-11)


def test_anomalies_obey_keplers_equation_and_third_law() -> None:
    elements = OsculatingElements(26600.0, 0.74, 1.1, 0.3, -1.57, 2.0)
    eccentric = elements.eccentric_anomaly_rad
    radius_km = 26600.0 * (1 - 0.74 * np.cos(eccentric))
    assert np.linalg.norm(state_from_elements(elements)[0]) == pytest.approx(radius_km, rel=1e-12)
    assert elements.mean_anomaly_rad == pytest.approx(eccentric - 0.74 * np.sin(eccentric), abs=1e-15)
    assert elements.period_s() == pytest.approx(43175.0, abs=5.0)  # half a sidereal day, Molniya


@pytest.mark.parametrize(
    "state",
    [
        ((7000.0, 0.0, 0.0), (0.0, 11.0, 0.0)),
        ((7000.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 7.0, 0.0)),
        ((np.nan, 0.0, 0.0), (0.0, 7.0, 0.0)),
    ],
)
def test_what_is_no_ellipse_is_refused(state: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    with pytest.raises(OrbitFormatError, match="closed orbit"):
        elements_from_state(*state)
    with pytest.raises(OrbitFormatError, match="e < 1"):
        state_from_elements(OsculatingElements(7000.0, 1.0, 0.0, 0.0, 0.0, 0.0))

"""State vectors in JSON: what is read, and everything that is wrong, at once."""

import json

import numpy as np
import pytest

from magcal_core.errors import OrbitFormatError
from magcal_core.orbit.messages.state import parse_state

GOOD = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "GCRF",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}


def test_a_state_is_read_and_written_back_the_same() -> None:
    state = parse_state(json.dumps(GOOD))
    assert state.epoch_utc == np.datetime64("2022-02-19T22:37:44.130")
    np.testing.assert_array_equal(state.r_km, GOOD["position_km"])
    again = parse_state(state.text)
    assert (again.text, again.frame) == (state.text, "GCRF")


def test_offsets_of_zones_are_taken_off() -> None:
    state = parse_state(json.dumps(GOOD | {"epoch": "2022-02-20T01:37:44.13+03:00"}))
    assert state.epoch_utc == np.datetime64("2022-02-19T22:37:44.130")


def test_other_frames_come_back_to_gcrf() -> None:
    state = parse_state(json.dumps(GOOD))
    for frame in ("ITRF", "TEME", "J2000", "EME2000"):
        again = parse_state(state.in_frame(frame).text).in_frame("GCRF")
        np.testing.assert_allclose(again.r_km, state.r_km, rtol=0, atol=1e-8)
        np.testing.assert_allclose(again.v_km_s, state.v_km_s, rtol=0, atol=1e-11)


def test_elements_are_those_of_the_inertial_state() -> None:
    assert parse_state(json.dumps(GOOD)).elements().semi_major_axis_km == pytest.approx(6938.5238, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "where", "why"),
    [
        ({"frame": "NED"}, "frame", "unknown; known are GCRF"),
        ({"frame": None}, "frame", "unknown"),
        ({"epoch": "2022-02-19T22:37:44"}, "epoch", "no zone"),
        ({"epoch": "yesterday"}, "epoch", "is not an epoch"),
        ({"epoch": 1645310264}, "epoch", "is not text"),
        ({"epoch": "2022-02-30T00:00:00Z"}, "epoch", "no day"),
        ({"epoch": "2022-02-19T25:00:00Z"}, "epoch", "time of day"),
        ({"position_km": [1.0, 2.0]}, "position_km", "three finite numbers"),
        ({"position_km": [6861897.8, -934381.1, -14668.5]}, "position_km", "want 6300 to 1000000 km"),
        ({"velocity_km_s": [0.0, float("nan"), 7.0]}, "velocity_km_s", "three finite numbers"),
        ({"velocity_km_s": [True, 0.0, 7.0]}, "velocity_km_s", "three finite numbers"),
        ({"velocity_km_s": ["0", 0.0, 7.0]}, "velocity_km_s", "three finite numbers"),
        ({"mass_kg": 4.0}, "mass_kg", "unknown"),
    ],
)
def test_each_wrong_key_is_named(change: dict[str, object], where: str, why: str) -> None:
    with pytest.raises(OrbitFormatError) as caught:
        parse_state(json.dumps(GOOD | change))
    (fault,) = caught.value.faults
    assert fault.where == where
    assert why in fault.why


def test_missing_keys_are_all_named() -> None:
    with pytest.raises(OrbitFormatError) as caught:
        parse_state("{}")
    assert [fault.where for fault in caught.value.faults] == ["epoch", "frame", "position_km", "velocity_km_s"]


@pytest.mark.parametrize("text", ["", "[]", "1", "[" * 100_000, '{"epoch": ' + "9" * 5000 + "}"])
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(OrbitFormatError):
        parse_state(text)


def test_a_state_that_escapes_is_refused() -> None:
    with pytest.raises(OrbitFormatError, match="closed orbit"):
        parse_state(json.dumps(GOOD | {"velocity_km_s": [0.0, -11.5, 7.5]}))

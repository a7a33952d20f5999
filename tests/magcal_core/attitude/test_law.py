import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from magcal_core.attitude.law import DEGENERATE, GUARDED, Law, command, minimal_quaternion
from magcal_core.attitude.rotation import rotate

N = 1.1e-3
DIRECTIONS = (
    hnp.arrays(np.float64, 3, elements=st.floats(-1.0, 1.0))
    .filter(lambda v: np.linalg.norm(v) > 1e-2)
    .map(lambda v: v / np.linalg.norm(v))
)
IDENTITY = (1.0, 0.0, 0.0, 0.0)
REST = (0.0, 0.0, 0.0)


@given(DIRECTIONS, DIRECTIONS)
def test_minimal_turn_takes_the_model_direction_to_the_measured_one(alpha, b):
    theta, length = minimal_quaternion(tuple(alpha), tuple(b), DEGENERATE)
    np.testing.assert_allclose(rotate(np.array(theta), b), alpha, atol=1e-7)  # half the digits near opposite
    assert length == pytest.approx(2.0 * np.cos(np.arccos(np.clip(alpha @ b, -1, 1)) / 2.0), abs=1e-7)


@given(DIRECTIONS)
def test_opposite_directions_give_a_half_turn_across_the_field(b):
    theta, length = minimal_quaternion(tuple(-b), tuple(b), DEGENERATE)
    assert length < DEGENERATE
    np.testing.assert_allclose(np.linalg.norm(theta), 1.0, atol=1e-12)
    np.testing.assert_allclose(rotate(np.array(theta), b), -b, atol=1e-12)


def test_the_guard_acts_where_the_plain_law_still_trusts_the_cross_product():
    b = (0.0, 0.0, 1.0)
    alpha = (0.0, 0.04, -np.sqrt(1.0 - 0.04**2))
    plain, length = minimal_quaternion(alpha, b, DEGENERATE)
    guarded, _ = minimal_quaternion(alpha, b, GUARDED)
    assert DEGENERATE < length < GUARDED
    assert plain[0] > 0.0
    assert guarded[0] == 0.0


@pytest.mark.parametrize("is_printed", [False, True])
def test_there_is_no_torque_where_nothing_is_to_be_done(is_printed):
    """Aligned, turning with the orbit, no programme: both forms rest."""
    law = Law(0.05, 20.0, N, is_printed, DEGENERATE)
    torque, _ = command(law, (0.6, 0.8, 0.0), (0.6, 0.8, 0.0), (0.0, 0.0, -N), (IDENTITY, REST))
    np.testing.assert_allclose(torque, 0.0, atol=1e-18)


def test_the_torque_turns_the_body_back():
    """The body turned by +0.1 rad about X sees the field turned by -0.1 rad: the torque is about -X."""
    law = Law(0.05, 20.0, N, False, DEGENERATE)
    b = np.array([0.0, 1.0, 0.0])
    alpha = rotate(np.array([np.cos(0.05), np.sin(0.05), 0.0, 0.0]), b)
    torque, _ = command(law, tuple(alpha), tuple(b), (0.0, 0.0, -N), (IDENTITY, REST))
    assert torque[0] == pytest.approx(-0.05 * np.sin(0.05), rel=0.02)  # the rate term adds kd n / 2 times the angle
    assert law.kp > 0.0


def test_only_the_corrected_form_rests_in_a_programmed_attitude():
    """The factor P stands on the wrong term as printed: w_o is taken in axes that it is not in."""
    programme = (np.cos(0.6), 0.0, np.sin(0.6), 0.0)
    programme = (programme[0] * np.cos(0.4), np.sin(0.4) * np.cos(0.6), programme[2], 0.0)
    q = np.array(programme) / np.linalg.norm(programme)
    b = np.array([0.36, 0.48, 0.8])
    alpha, rate = rotate(q, b), rotate(q, np.array([0.0, 0.0, -N]))
    torques = {}
    for is_printed in (False, True):
        law = Law(0.05, 20.0, N, is_printed, DEGENERATE)
        torques[is_printed], _ = command(law, tuple(alpha), tuple(b), tuple(rate), (tuple(q), REST))
    np.testing.assert_allclose(torques[False], 0.0, atol=1e-15)
    assert np.linalg.norm(torques[True]) > 0.1 * 10.0 * N

import numpy as np
import pytest

from magcal_core.attitude.programme import Turn
from magcal_core.attitude.rotation import attitude_matrix, conjugate, euler_matrix, multiply
from magcal_core.errors import InputError

ANGLES = (2.9, 1.4, 1.9)


def test_a_step_is_there_at_once_and_at_rest():
    q, rate = Turn(ANGLES).attitude(np.array([0.0, 5.0]))
    np.testing.assert_allclose(attitude_matrix(q[0]), euler_matrix(*ANGLES), atol=1e-12)
    np.testing.assert_allclose(rate, 0.0, atol=0)


def test_a_ramp_starts_at_the_orbital_axes_ends_at_the_angles_and_rests_at_both():
    q, rate = Turn(ANGLES, 2000.0).attitude(np.array([0.0, 1000.0, 2000.0, 5000.0]))
    np.testing.assert_allclose(q[0], [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(attitude_matrix(q[1]), euler_matrix(*(0.5 * a for a in ANGLES)), atol=1e-12)
    np.testing.assert_allclose(attitude_matrix(q[3]), euler_matrix(*ANGLES), atol=1e-12)
    np.testing.assert_allclose(rate[[0, 2, 3]], 0.0, atol=1e-15)


def test_the_programmed_rate_is_the_derivative_of_the_programmed_attitude():
    """q' = q o w / 2, by central difference over 0.1 s: its error is 1e-9 rad/s."""
    turn, t, step = Turn(ANGLES, 2000.0), np.linspace(100.0, 1900.0, 19), 0.05
    q, rate = turn.attitude(t)
    change = (turn.attitude(t + step)[0] - turn.attitude(t - step)[0]) / (2.0 * step)
    np.testing.assert_allclose(2.0 * multiply(conjugate(q), change)[:, 1:], rate, atol=1e-9)


@pytest.mark.parametrize("wrong", [{"ramp_s": -1.0}, {"angles_rad": (np.inf, 0.0, 0.0)}])
def test_a_turn_that_cannot_be_is_refused(wrong):
    with pytest.raises(InputError):
        Turn(**wrong)

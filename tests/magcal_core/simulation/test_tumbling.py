"""Torque-free motion against Euler's equations integrated by scipy, and against what the motion conserves."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from magcal_core.attitude.rotation import attitude_matrix
from magcal_core.errors import OptionError
from magcal_core.simulation.tumbling import Tumbling

Floats = NDArray[np.float64]

DEKART_BOX = (0.0973, 0.0785, 0.0313)
CASES = {
    "about the largest": (DEKART_BOX, (1.0, 0.1, 0.2)),
    "about the smallest": (DEKART_BOX, (0.1, -0.2, 1.0)),
    "backwards about the smallest": (DEKART_BOX, (-0.1, 0.2, -1.0)),
    "tumbling hard": (DEKART_BOX, (0.35, 0.9, 0.1)),
    "other order of the axes": ((0.0313, 0.0973, 0.0785), (0.4, -0.7, 0.5)),
    "third order of the axes": ((0.0785, 0.0313, 0.0973), (-0.4, -0.7, 0.5)),
    "rod": ((1.0, 1.0, 0.1), (0.3, 0.4, 0.5)),
    "disc": ((1.0, 1.0, 1.9), (0.3, -0.4, 0.5)),
    "sphere": ((1.0, 1.0, 1.0), (0.3, -0.4, 0.5)),
    "principal spin": (DEKART_BOX, (0.0, 0.0, 1.0)),
    "spin about the middle axis": (DEKART_BOX, (0.0, 1.0, 0.0)),
    "at rest": (DEKART_BOX, (0.0, 0.0, 0.0)),
}


def integrated(moments: Floats, rate: Floats, q0: Floats, t_s: Floats) -> tuple[Floats, Floats]:
    def slope(_: float, y: Floats) -> Floats:
        q, w = y[:4], y[4:]
        v = q[1:]
        turning = 0.5 * np.concatenate([[-v @ w], q[0] * w + np.cross(v, w)])
        return np.concatenate([turning, np.cross(moments * w, w) / moments])

    y = solve_ivp(slope, (0.0, t_s[-1]), [*q0, *rate], "DOP853", t_s, rtol=1e-12, atol=1e-13).y.T
    return y[:, :4], y[:, 4:]


@pytest.mark.parametrize("case", CASES)
def test_the_closed_form_is_what_eulers_equations_integrate_to(case: str) -> None:
    """Twenty rad of turning; DOP853 at 1e-12 is good to about 1e-10."""
    moments, rate = (np.array(values) for values in CASES[case])
    q0 = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
    t_s = np.linspace(0.0, 20.0, 81)
    q, w = Tumbling(moments, rate, q0).motion(t_s)
    q_want, w_want = integrated(moments, rate, q0, t_s)
    np.testing.assert_allclose(w, w_want, atol=1e-9)
    np.testing.assert_allclose(attitude_matrix(q), attitude_matrix(q_want), atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize("case", CASES)
def test_momentum_in_inertial_axes_and_energy_stay_for_months(case: str) -> None:
    moments, rate = (np.array(values) for values in CASES[case])
    q, w = Tumbling(moments, rate, np.array([1.0, 0.0, 0.0, 0.0])).motion(np.linspace(0.0, 1e7, 1001))
    momentum = (np.swapaxes(attitude_matrix(q), 1, 2) @ (moments * w)[..., None])[..., 0]
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (1001, 1)), atol=1e-12)
    np.testing.assert_allclose(w**2 @ moments, rate**2 @ moments, rtol=1e-10)


def test_a_motion_on_the_separatrix_is_refused() -> None:
    body = Tumbling(np.array(DEKART_BOX), np.array([1e-12, 1.0, 1e-12]), np.array([1.0, 0.0, 0.0, 0.0]))
    with pytest.raises(OptionError, match="separatrix"):
        body.motion(np.zeros(1))


@pytest.mark.parametrize("moments", [(1.0, 1.0, 2.5), (1.0, -1.0, 1.0), (np.nan, 1.0, 1.0)])
def test_moments_that_no_body_has_are_refused(moments: tuple[float, ...]) -> None:
    with pytest.raises(OptionError):
        Tumbling(np.array(moments), np.ones(3), np.array([1.0, 0.0, 0.0, 0.0]))

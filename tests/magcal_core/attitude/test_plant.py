import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from magcal_core.attitude.plant import Body, advance, inertia_matrix, limited_torque, mechanics_of
from magcal_core.errors import InputError

N = 1.10678e-3  # rad/s, 500 km


def fly(body, state, torque, steps, dt):
    mechanics = mechanics_of(body, N)
    for _ in range(steps):
        state = advance(state, torque, mechanics, dt)
    return tuple(np.array(part) for part in state)


def test_free_body_agrees_with_an_independent_integration():
    """scipy's DOP853 on rotation matrices and the inertial frame, 1e-12: Runge-Kutta steps of 0.5 s leave 1e-10."""
    body = Body(inertia_matrix((70.0, 90.0, 80.0, 3.0, -2.0, 5.0)))
    w0, h0, torque = np.array([0.01, -0.02, 0.015]), np.array([0.3, -0.2, 0.1]), np.array([1e-3, 2e-3, -1e-3])
    j = body.inertia_kg_m2

    def slope(t, y):
        w, axes = y[:3], y[3:].reshape(3, 3)  # rows of axes: body axes in inertial components
        dw = np.linalg.solve(j, torque - np.cross(w, j @ w + h0 - torque * t))
        return np.concatenate([dw, (-np.cross(np.eye(3), w) @ axes).ravel()])

    end = solve_ivp(slope, (0, 300), np.concatenate([w0, np.eye(3).ravel()]), method="DOP853", rtol=1e-12, atol=1e-14)
    w_want, inertial_to_body = end.y[:3, -1], end.y[3:, -1].reshape(3, 3)
    q, w, h = fly(body, ((1.0, 0.0, 0.0, 0.0), tuple(w0), tuple(h0)), tuple(torque), 600, 0.5)
    orbital = Rotation.from_rotvec([0.0, 0.0, -N * 300.0]).as_matrix().T
    ours = Rotation.from_quat(q, scalar_first=True).as_matrix().T @ orbital
    np.testing.assert_allclose(w, w_want, atol=1e-10)
    np.testing.assert_allclose(ours, inertial_to_body, atol=1e-8)
    np.testing.assert_allclose(h, h0 - 300.0 * torque, atol=1e-12)


def test_momentum_stays_in_inertial_space_while_the_wheels_turn_the_body():
    """Wheel torques are internal: |J w + h| does not change; rounding and truncation leave 1e-9 Nms."""
    body = Body()
    state = ((1.0, 0.0, 0.0, 0.0), (0.01, 0.02, -0.01), (0.5, 0.1, -0.3))
    _, w, h = fly(body, state, (0.004, -0.003, 0.002), 400, 0.5)
    start = body.inertia_kg_m2 @ [0.01, 0.02, -0.01] + [0.5, 0.1, -0.3]
    np.testing.assert_allclose(np.linalg.norm(body.inertia_kg_m2 @ w + h), np.linalg.norm(start), atol=1e-9)


def test_gravity_gradient_swings_the_body_at_the_textbook_frequency():
    """Small libration in the orbit plane: n sqrt(3 (Jx - Jy) / Jz) with Y up, X along the motion; 0.01 rad, so 1e-4."""
    body = Body(inertia_matrix((90.0, 60.0, 80.0)), has_gravity_gradient=True)
    frequency = N * np.sqrt(3.0 * (90.0 - 60.0) / 80.0)
    small = 0.01
    start = (np.cos(small / 2), 0.0, 0.0, np.sin(small / 2))
    quarter = round(np.pi / 2 / frequency)
    q, _, _ = fly(body, (start, (0.0, 0.0, -N), (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), quarter, 1.0)
    assert abs(2.0 * q[3]) < 0.01 * small
    q, _, _ = fly(body, (start, (0.0, 0.0, -N), (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 2 * quarter, 1.0)
    np.testing.assert_allclose(2.0 * q[3], -small, rtol=1e-3)


def test_a_full_wheel_gives_no_more_momentum_but_takes_it_back():
    full = (5.0, -5.0, 4.99)
    np.testing.assert_allclose(
        limited_torque((-0.04, 0.04, -0.04), full, 0.05, 5.0, 0.5), (0.0, 0.0, -0.02), atol=1e-12
    )
    assert limited_torque((0.04, -0.04, 0.2), full, 0.05, 5.0, 0.5) == (0.04, -0.04, 0.05)


@pytest.mark.parametrize("moments", [(10.0, 20.0, 31.0), (0.0, 1.0, 1.0), (-1.0, 2.0, 2.0), (np.nan, 1.0, 1.0)])
def test_moments_that_no_body_has_are_refused(moments):
    with pytest.raises(InputError):
        Body(inertia_matrix(moments))


def test_an_inertia_of_four_numbers_is_refused():
    with pytest.raises(InputError, match="3 or 6"):
        inertia_matrix((1.0, 2.0, 3.0, 4.0))

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from magcal_core.attitude import rotation as rot
from magcal_core.errors import InputError

ROUNDING = 1e-12  # double precision through a dozen operations on numbers of order one
QUATERNIONS = (
    hnp.arrays(np.float64, 4, elements=st.floats(-1.0, 1.0))
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(lambda q: q / np.linalg.norm(q))
)


def oracle(q):
    """scipy's matrix turns vectors, ours turns axes: the transpose."""
    return Rotation.from_quat(q, scalar_first=True).as_matrix().T


@given(QUATERNIONS)
def test_attitude_matrix_is_scipys_transposed(q):
    np.testing.assert_allclose(rot.attitude_matrix(q), oracle(q), atol=ROUNDING)


def test_a_quarter_turn_about_z_takes_the_reference_x_axis_to_minus_body_y():
    q = np.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])
    np.testing.assert_allclose(rot.rotate(q, np.array([1.0, 0.0, 0.0])), [0.0, -1.0, 0.0], atol=ROUNDING)


def test_many_quaternions_give_as_many_matrices():
    q = rot.unit(np.random.default_rng(1).normal(size=(5, 4)))
    matrices = rot.attitude_matrix(q)
    assert matrices.shape == (5, 3, 3)
    np.testing.assert_allclose(matrices[3], rot.attitude_matrix(q[3]), atol=0)


def test_a_vector_by_each_quaternion_is_as_one_by_one():
    random = np.random.default_rng(2)
    q, v = rot.unit(random.normal(size=(50, 4))), random.normal(size=(50, 3))
    one_by_one = [oracle(turn) @ vector for turn, vector in zip(q, v, strict=True)]
    np.testing.assert_allclose(rot.rotate_rows(q, v), one_by_one, atol=ROUNDING)


@given(QUATERNIONS)
def test_matrix_and_quaternion_are_a_round_trip_up_to_sign(q):
    back = rot.quaternion_from_matrix(rot.attitude_matrix(q))
    assert back[0] >= 0.0
    np.testing.assert_allclose(abs(back @ q), 1.0, atol=ROUNDING)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_keep_all_digits(axis):
    matrix = -np.eye(3)
    matrix[axis, axis] = 1.0
    np.testing.assert_allclose(np.abs(rot.quaternion_from_matrix(matrix)), np.eye(4)[axis + 1], atol=ROUNDING)


def test_a_reflection_is_refused_by_name():
    with pytest.raises(InputError, match="not a rotation matrix"):
        rot.quaternion_from_matrix(-np.eye(3))


@given(QUATERNIONS, QUATERNIONS)
def test_product_is_the_first_turn_and_then_the_second(a, b):
    np.testing.assert_allclose(
        rot.attitude_matrix(rot.multiply(a, b)), rot.attitude_matrix(b) @ rot.attitude_matrix(a), atol=ROUNDING
    )


@given(QUATERNIONS)
def test_conjugate_undoes_the_turn(q):
    np.testing.assert_allclose(rot.multiply(q, rot.conjugate(q)), [1, 0, 0, 0], atol=ROUNDING)


@given(hnp.arrays(np.float64, 3, elements=st.floats(-1.8, 1.8)))
def test_rotation_vector_and_angle_agree_with_scipy(vector):
    q = rot.from_rotation_vector(vector)
    want = Rotation.from_rotvec(vector)
    np.testing.assert_allclose(rot.attitude_matrix(q), want.as_matrix().T, atol=ROUNDING)
    np.testing.assert_allclose(rot.rotation_angle(q), want.magnitude(), atol=1e-7)  # atan2 near pi


def test_zero_quaternion_has_no_direction():
    with pytest.raises(InputError, match="no direction"):
        rot.unit(np.zeros(4))


def test_euler_matrix_turns_about_y_then_z_then_x():
    """scipy's intrinsic YZX sequence, transposed because ours takes components, not vectors."""
    psi, theta, gamma = 0.3, -0.8, 2.1
    want = Rotation.from_euler("YZX", [psi, theta, gamma]).as_matrix().T
    np.testing.assert_allclose(rot.euler_matrix(psi, theta, gamma), want, atol=ROUNDING)


def test_the_papers_start_is_displayed_with_theta_inside_its_range():
    """(110, -130, 170) deg and (-70, -50, -10) deg are the same attitude (ROM, section 1)."""
    start = rot.euler_matrix(*np.deg2rad([110.0, -130.0, 170.0]))
    np.testing.assert_allclose(np.rad2deg(rot.euler_angles(start)), [-70.0, -50.0, -10.0], atol=1e-10)

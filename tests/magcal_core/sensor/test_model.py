"""The sensor model and its conventions, against the printed formulas and against themselves by round trips."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magcal_core.errors import InputError, OptionError
from magcal_core.sensor.conventions import CONVENTIONS, convert, first_order_a
from magcal_core.sensor.model import SensorModel, lower_triangular_gauge

TABLE_1 = {
    "bias_nt": [2928.125, -1191.25, -1875.625],
    "scale": [1.032695, 1.006685, 1.032875],
    "nonorthogonality_deg": [-4.53, -1.067, 7.915],
}

finite = {"allow_nan": False, "allow_infinity": False}
sensors = st.builds(
    lambda b, k, signs, e: {
        "bias_nt": b,
        "scale": [x * s for x, s in zip(k, signs, strict=True)],
        "nonorthogonality_deg": e,
    },
    st.lists(st.floats(-6e4, 6e4, **finite), min_size=3, max_size=3),
    st.lists(st.floats(0.3, 3.0, **finite), min_size=3, max_size=3),
    st.lists(st.sampled_from([1.0, -1.0]), min_size=3, max_size=3),
    st.lists(st.floats(-50.0, 50.0, **finite), min_size=3, max_size=3),
)


def test_matrix_has_the_printed_rows():
    k, e = TABLE_1["scale"], np.deg2rad(TABLE_1["nonorthogonality_deg"])
    s, c = np.sin(e), np.cos(e)
    rows = [
        [k[0], 0, 0],
        [k[1] * s[0], k[1] * c[0], 0],
        [k[2] * s[1], k[2] * c[1] * s[2], k[2] * c[1] * c[2]],
    ]
    np.testing.assert_allclose(SensorModel(**TABLE_1).matrix, rows, rtol=1e-15, atol=1e-16)


def test_correction_matrix_is_the_printed_inverse():
    """The closed form of S = P^-1 Q^-1 in tan e, sec e and 1/k, derived on paper."""
    a, b = np.tan(np.deg2rad(TABLE_1["nonorthogonality_deg"])), 1 / np.cos(np.deg2rad(TABLE_1["nonorthogonality_deg"]))
    g = 1 / np.array(TABLE_1["scale"])
    s = [
        [g[0], 0, 0],
        [-a[0] * g[0], b[0] * g[1], 0],
        [(a[0] * a[2] - a[1] * b[2]) * g[0], -a[2] * b[0] * g[1], b[1] * b[2] * g[2]],
    ]
    np.testing.assert_allclose(SensorModel(**TABLE_1).correction_matrix, s, rtol=1e-14, atol=1e-16)


@given(sensors)
def test_correct_undoes_apply(parameters):
    sensor = SensorModel(**parameters)
    b_nt = np.array([[30000.0, -20000.0, 10000.0], [1.0, 2.0, 3.0], [-45000.0, 0.0, 0.0]])
    np.testing.assert_allclose(sensor.correct(sensor.apply(b_nt)), b_nt, atol=1e-8)


@pytest.mark.parametrize("through", [name for name in CONVENTIONS if name != "exact"])
@settings(max_examples=200)
@given(parameters=sensors)
def test_round_trip_loses_nothing(through, parameters):
    """12 digits: the factorisations lose a few of the sixteen where axes stand at 50 deg and scales differ tenfold."""
    back = convert(convert(parameters, "exact", through), through, "exact")
    for name, value in parameters.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-12, atol=1e-11, err_msg=name)


@pytest.mark.parametrize("first", CONVENTIONS)
@pytest.mark.parametrize("second", CONVENTIONS)
def test_every_pair_of_conventions_round_trips(first, second):
    start = convert(TABLE_1, "exact", first)
    back = convert(convert(start, first, second), second, first)
    for name, value in start.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-12, atol=1e-15, err_msg=name)


@given(parameters=sensors)
def test_the_on_board_table_corrects_as_the_sensor_model_does(parameters):
    h_nt = np.array([[30000.0, -20000.0, 10000.0], [5000.0, 42000.0, -9000.0], [-45000.0, 0.0, 300.0]])
    table = convert(parameters, "exact", "on-board")
    corrected_nt = (np.array(table["scale"]) * (h_nt - np.array(table["bias_nt"]))) @ np.array(table["rotation"]).T
    np.testing.assert_allclose(corrected_nt, SensorModel(**parameters).correct(h_nt), rtol=1e-11, atol=1e-6)


@pytest.mark.parametrize("target", ["symmetric", "lower-triangular", "a-matrix"])
@given(parameters=sensors)
def test_conventions_agree_on_the_magnitude(target, parameters):
    h_nt = np.array([[30000.0, -20000.0, 10000.0], [5000.0, 42000.0, -9000.0], [-45000.0, 0.0, 300.0]])
    want = np.linalg.norm(SensorModel(**parameters).correct(h_nt), axis=1)
    other = convert(parameters, "exact", target)
    x = h_nt - np.array(other["bias_nt"])
    matrix = np.array(other["matrix"])
    if target == "a-matrix":
        got = np.sqrt(np.einsum("ni,ij,nj->n", x, matrix, x))
    else:
        got = np.linalg.norm(np.linalg.solve(matrix, x.T).T, axis=1)
    np.testing.assert_allclose(got, want, rtol=1e-9)


@pytest.mark.parametrize(
    ("printed_scale", "printed_deg", "scale", "deg"),
    [
        (
            [1.032695, 1.006685, 1.032875],
            [-4.53, -1.067, 7.915],
            [1.036402, 1.019902, 1.043341],
            [-4.729, -1.715, 7.940],
        ),
        (
            [1.024175, 0.988788, 1.026907],
            [-4.22, -2.133, 8.504],
            [1.028191, 1.003087, 1.039649],
            [-4.596, -2.799, 8.536],
        ),
    ],
)
def test_first_order_parameters_of_dekart_become_the_tabulated_exact_ones(printed_scale, printed_deg, scale, deg):
    """Tables 1 and 2 of [DEKART], read as first-order parameters; the exact ones were computed independently."""
    first = {"bias_nt": [0, 0, 0], "scale": printed_scale, "nonorthogonality_deg": printed_deg}
    exact = convert(first, "first-order", "exact")
    np.testing.assert_allclose(exact["scale"], scale, atol=6e-7)
    np.testing.assert_allclose(exact["nonorthogonality_deg"], deg, atol=6e-4)


def test_inverted_axes_are_carried_where_the_magnitude_cannot_show_them():
    left_handed = TABLE_1 | {"scale": [1.03, -1.0, 1.04]}
    first = convert(left_handed, "exact", "first-order")
    assert first["axis_signs"] == [1.0, -1.0, 1.0]
    assert "axis_signs" not in convert(TABLE_1, "exact", "first-order")


def test_what_does_not_depend_on_the_convention_is_passed_through():
    got = convert(TABLE_1 | {"time_offset_s": 1.5, "regressors": {"t": [1, 2, 3]}}, "exact", "a-matrix")
    assert got["time_offset_s"] == 1.5
    assert got["regressors"] == {"t": [1, 2, 3]}


@pytest.mark.parametrize(
    ("parameters", "source"),
    [
        (TABLE_1 | {"nonorthogonality_deg": [60.0, 60.0, 60.0]}, "first-order"),
        ({"bias_nt": [0, 0, 0], "matrix": np.diag([1.0, 1.0, -1.0]).tolist()}, "a-matrix"),
        ({"bias_nt": [0, 0, 0], "matrix": np.diag([1.0, 1.0, -1.0]).tolist()}, "symmetric"),
        ({"bias_nt": [0, 0, 0], "matrix": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "a-matrix"),
        ({"bias_nt": [0, 0, 0], "matrix": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "lower-triangular"),
        ({"bias_nt": [0, 0, 0], "matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "lower-triangular"),
        (TABLE_1 | {"scale": [1.0, 0.0, 1.0]}, "exact"),
        (TABLE_1 | {"nonorthogonality_deg": [0.0, 95.0, 0.0]}, "exact"),
        (TABLE_1 | {"bias_nt": [0.0, float("nan"), 0.0]}, "exact"),
        (TABLE_1 | {"bias_nt": "none"}, "exact"),
        ({"bias_nt": [0, 0, 0]}, "symmetric"),
    ],
)
def test_parameters_that_no_sensor_has_are_refused(parameters, source):
    with pytest.raises(InputError):
        convert(parameters, source, "lower-triangular" if source != "lower-triangular" else "exact")


def test_unknown_conventions_are_refused_by_name():
    with pytest.raises(OptionError, match="'ned'"):
        convert(TABLE_1, "ned", "exact")


@settings(max_examples=100)
@given(st.lists(st.floats(-1, 1, **finite), min_size=9, max_size=9))
def test_any_regular_matrix_splits_into_a_sensor_and_a_rotation(values):
    matrix = np.array(values).reshape(3, 3) + 2 * np.eye(3)
    lower, rotation = lower_triangular_gauge(matrix)
    np.testing.assert_allclose(lower @ rotation, matrix, atol=1e-14)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.all(np.triu(lower, 1) == 0)
    assert np.all(np.diag(lower) >= 0)


def test_first_order_a_is_the_printed_matrix():
    k, e = np.array([1.1, 0.9, 1.2]), np.array([0.01, -0.02, 0.03])
    want = np.diag(1 / k) @ [[1, -0.01, 0.02], [-0.01, 1, -0.03], [0.02, -0.03, 1]] @ np.diag(1 / k)
    np.testing.assert_allclose(first_order_a(k, e), want, rtol=1e-15)

"""Samples: the table that flows through the core keeps its shape, its flags and its columns apart."""

import numpy as np
import pytest

from magcal_core.errors import TelemetryValueError
from magcal_core.samples import EXCLUDED, SampleFlag, Samples

N = 5
T = np.datetime64("2022-02-19", "ns") + np.arange(N) * np.timedelta64(10, "s")


def samples(**columns: object) -> Samples:
    return Samples(T, np.arange(3.0 * N).reshape(N, 3), **columns)  # type: ignore[arg-type]


def test_samples_without_flags_are_all_used() -> None:
    made = samples()
    assert made.flags.dtype == np.uint16
    assert made.is_used.all()
    assert len(made) == N


@pytest.mark.parametrize("flag", list(SampleFlag))
def test_a_flag_keeps_a_sample_out_exactly_where_it_excludes(flag: SampleFlag) -> None:
    flagged = samples().flagged(flag, np.arange(N) == 2)
    assert flagged.is_used.tolist() == [i != 2 or not flag & EXCLUDED for i in range(N)]


def test_flagging_adds_to_what_is_there_and_leaves_the_original_alone() -> None:
    first = samples().flagged(SampleFlag.SPIKE, np.arange(N) < 3)
    second = first.flagged(SampleFlag.JUMP, np.arange(N) > 1)
    assert second.flags.tolist() == [16, 16, 48, 32, 32]
    assert first.flags.tolist() == [16, 16, 16, 0, 0]


@pytest.mark.parametrize("index", [np.array([4, 1]), np.array([False, True, False, False, True]), slice(1, 3)])
def test_taking_rows_takes_every_column(index: np.ndarray | slice) -> None:
    made = samples(
        q_base_gcrf=np.arange(4.0 * N).reshape(N, 4),
        b_ref_magnitude_nt=np.arange(N, dtype=float),
        housekeeping={"temperature": np.arange(N) * 2.0},
        flags=np.arange(N, dtype=np.uint16),
    )
    taken = made.take(index)
    rows = np.arange(N)[index]
    assert taken.q_base_gcrf is not None
    np.testing.assert_array_equal(taken.t_utc, T[rows])
    np.testing.assert_array_equal(taken.q_base_gcrf[:, 0], 4.0 * rows)
    np.testing.assert_array_equal(taken.b_ref_magnitude_nt, rows)
    np.testing.assert_array_equal(taken.housekeeping["temperature"], 2.0 * rows)
    np.testing.assert_array_equal(taken.flags, rows)
    assert taken.b_ref_base_nt is None


def test_housekeeping_may_bear_the_name_of_a_column_of_ours() -> None:
    made = samples(housekeeping={"flags": np.full(N, 7.0), "h_nt": np.zeros(N)})
    taken = made.flagged(SampleFlag.SATURATED, np.arange(N) == 0).take(slice(0, 2))
    assert taken.flags.tolist() == [SampleFlag.SATURATED, 0]
    assert taken.housekeeping["flags"].tolist() == [7.0, 7.0]


@pytest.mark.parametrize(
    "columns",
    [
        {"q_base_gcrf": np.zeros((N, 3))},
        {"b_ref_magnitude_nt": np.zeros((N, 1))},
        {"r_itrf_km": np.zeros((N - 1, 3))},
        {"housekeeping": {"temperature": np.zeros(N + 1)}},
        {"flags": np.zeros(N - 1, np.uint16)},
    ],
)
def test_columns_of_another_shape_are_refused(columns: dict[str, object]) -> None:
    with pytest.raises(TelemetryValueError, match="has shape"):
        samples(**columns)


@pytest.mark.parametrize("name", ["b_ref_base_nt", "b_ref_gcrf_nt", "b_ref_magnitude_nt"])
def test_any_form_of_reference_counts(name: str) -> None:
    column = np.zeros(N) if name == "b_ref_magnitude_nt" else np.zeros((N, 3))
    assert samples(**{name: column}).has_reference
    assert not samples().has_reference


def test_a_mask_that_keeps_all_copies_nothing():
    """Ten million samples pass a dozen masks: a copy each would be gigabytes."""
    samples = Samples(np.array(["2022-02-19", "2022-02-20"], "datetime64[ns]"), np.ones((2, 3)))
    assert samples.take(np.array([True, True])) is samples
    assert len(samples.take(np.array([True, False]))) == 1

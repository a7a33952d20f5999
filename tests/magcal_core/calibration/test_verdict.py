"""The verdict: a figure that is no finite number is never one that passes."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from magcal_core.calibration.residuals import ResidualStatistics
from magcal_core.calibration.sessions.consistency import ParameterDifference
from magcal_core.calibration.uncertainty.field_error import FieldError
from magcal_core.calibration.verdict.agreement import Agreement
from magcal_core.calibration.verdict.verdict import Evidence, Turn, judge
from magcal_core.sensor.parameters import Parameters

PARAMETERS = Parameters(np.array([2900.0, -1200.0, -1900.0]), np.array([1.03, 1.01, 1.04]), np.array([-4.0, -1.5, 7.0]))
ERRORS = Parameters(np.full(3, 10.0), np.full(3, 3e-4), np.full(3, 0.02))
RESIDUAL = ResidualStatistics(0.0, 80.0, 80.0, 300.0, 0.9)
GOOD = Evidence(
    index=40.0,
    field_error=FieldError(0.004, np.array([1.0, 0.0, 0.0]), "bias"),
    parameters=PARAMETERS,
    standard_errors=ERRORS,
    mean_field_nt=35e3,
    field_variation=0.2,
    before=replace(RESIDUAL, rms_nt=3000.0),
    after=RESIDUAL,
    cross_validated_rms_nt=82.0,
    rejected_share=0.0,
    without_reading_share=0.0,
    is_converged=True,
    is_vector=False,
    is_plain=True,
    orbit_age_days=0.5,
    has_time_offset=False,
)
FIGURES = [
    name for name in (field.name for field in dataclasses.fields(Evidence)) if isinstance(getattr(GOOD, name), float)
]


def broken(group: str, value: float) -> Parameters:
    """Return the standard errors with one of them ``value``."""
    worse = getattr(ERRORS, group).copy()
    worse[1] = value
    return replace(ERRORS, **{group: worse})


def test_the_evidence_is_good_as_it_stands() -> None:
    assert judge(GOOD).grade == "accept"
    assert {"index", "mean_field_nt", "cross_validated_rms_nt", "rejected_share", "without_reading_share"} <= set(
        FIGURES
    )


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_that_is_no_number_refuses(name: str) -> None:
    assert judge(replace(GOOD, **{name: float("nan")})).grade == "refuse"


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_error_of_the_field_that_is_not_finite_refuses(value: float) -> None:
    assert judge(replace(GOOD, field_error=replace(GOOD.field_error, share=value))).grade == "refuse"


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["angle_deg", "error_deg"])
def test_a_turn_that_is_not_finite_refuses(name: str, value: float) -> None:
    known = Turn(1.0, 0.1)
    assert judge(replace(GOOD, turn=known)).grade == "accept"
    assert judge(replace(GOOD, turn=replace(known, **{name: value}))).grade == "refuse"


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("group", ["bias_nt", "scale", "nonorthogonality_deg"])
def test_a_standard_error_that_is_not_finite_refuses(group: str, value: float) -> None:
    verdict = judge(replace(GOOD, standard_errors=broken(group, value)))
    assert verdict.grade == "refuse"
    assert any("not a finite number" in reason.text for reason in verdict.reasons)


@pytest.mark.parametrize("group", ["bias_nt", "scale", "nonorthogonality_deg"])
def test_a_parameter_that_is_no_number_refuses(group: str) -> None:
    worse = getattr(PARAMETERS, group) * np.array([1.0, np.nan, 1.0])
    assert judge(replace(GOOD, parameters=replace(PARAMETERS, **{group: worse}))).grade == "refuse"


@pytest.mark.parametrize("side", ["before", "after"])
@pytest.mark.parametrize("name", ["mean_nt", "std_nt", "rms_nt"])
def test_residual_statistics_that_are_no_numbers_refuse(side: str, name: str) -> None:
    worse = replace(getattr(GOOD, side), **{name: float("nan")})
    assert judge(replace(GOOD, **{side: worse})).grade == "refuse"


def test_a_comparison_that_is_no_number_refuses() -> None:
    same = Agreement((ParameterDifference("bias_nt[0]", "active", "new", 1.0, 10.0, 0.9),), 5.0, 9.0, 350.0, 1.0)
    assert judge(replace(GOOD, agreement=same)).grade == "accept"
    assert judge(replace(GOOD, agreement=replace(same, field_change_nt=float("nan")))).grade == "refuse"

"""Reasons in plain words: every code that a verdict may have is explained, and a cure changes what it says it does."""

import ast
import inspect

import pytest

from app.jobs.schemas import CalibrationBody
from app.parameter_sets.reasons import REASONS, Subject, explained
from magcal_core import bias_in_session
from magcal_core.calibration.verdict import verdict

PLACES = {"Reason": 0, "_graded": 2}
"""Which argument of a call is the reason's code."""
PLAIN = {"method": "scalar", "robust": "none", "time_offset": "auto", "regressors": [], "noise_nt": None}


def subject(**options: object) -> Subject:
    return Subject("a" * 32, "dekart", ["b" * 32], PLAIN | options, ["temperature"], "c" * 32)


def test_every_code_of_a_verdict_is_explained() -> None:
    """The codes as the sources that make verdicts write them."""
    calls = [
        node
        for module in (verdict, bias_in_session)
        for node in ast.walk(ast.parse(inspect.getsource(module)))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in PLACES
    ]
    given = [call.args[PLACES[call.func.id]] for call in calls]
    codes = {argument.value for argument in given if isinstance(argument, ast.Constant)}
    assert codes <= set(REASONS)
    assert {"not_observable", "large_residual", "storm", "bias_step"} <= codes


@pytest.mark.parametrize(
    ("code", "options", "label", "change"),
    [
        ("many_rejected", {}, "Again with tukey", {"robust": "tukey"}),
        (
            "large_residual",
            {"robust": "tukey"},
            "With the regressors that unseen blocks support",
            {"regressors": "auto"},
        ),
        ("poor_on_unseen_data", {"regressors": ["temperature"]}, "Without regressors", {"regressors": []}),
        ("orbit_old", {}, "Look for the clock", {"time_offset": "estimate"}),
        ("bias_step", {}, "With the steps fitted", {"bias_steps": "fit"}),
        ("misaligned", {"method": "vector"}, "Again from |B| alone", {"method": "scalar"}),
    ],
)
def test_a_cure_is_the_same_calibration_with_one_option_changed(code, options, label, change) -> None:
    (reason,) = explained([f"{code}: 0.3, limit 0.25"], ["refuse"], subject(**options))
    assert reason.cure is not None
    assert (reason.grade, reason.figure, reason.cure.label) == ("refuse", "0.3, limit 0.25", label)
    body = CalibrationBody.model_validate(dict(reason.cure.body or {}))
    wanted = {name: value for name, value in (PLAIN | options | change).items() if value is not None}
    assert body.options == wanted
    assert body.session_ids == ["b" * 32]


def test_a_cure_that_was_taken_already_or_cannot_be_is_not_offered() -> None:
    (reason,) = explained(["many_rejected: x"], ["weak"], subject(robust="tukey"))
    assert reason.cure is None
    (step,) = explained(["bias_step: x"], ["weak"], subject(method="vector-closed-form"))
    assert step.cure is None
    (orbit,) = explained(["orbit_old: x"], ["weak"], subject(time_offset="estimate"))
    assert (orbit.cure.method, orbit.cure.path) == ("GET", "/satellites/dekart#orbits")


def test_sets_from_before_grades_were_kept_and_unknown_codes_are_explained_too() -> None:
    (old, new) = explained(["bias_uncertain: x", "from_tomorrow: y"], [], subject())
    assert old.grade is None
    assert (new.code, new.figure, new.cure) == ("from_tomorrow", "y", None)

"""Every code that a verdict or a judgement of a session can give stands in the documentation, with what to do."""

import ast
import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

from magcal_core.calibration.diagnosis.wrong_input import suspicions
from magcal_core.calibration.sessions import monitoring
from magcal_core.calibration.verdict import verdict

DOCS = Path(__file__).parents[3] / "docs"


def codes(module: ModuleType) -> set[str]:
    """The codes that ``module`` gives: first argument of `Reason`, third of `_graded`."""
    found = set()
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            place = {"Reason": 0, "_graded": 2}.get(node.func.id)
            if place is not None and isinstance(node.args[place], ast.Constant):
                found.add(str(node.args[place].value))
    return found


def words(*names: str) -> set[str]:
    return set(re.findall(r"`(\w+)`", "".join((DOCS / name).read_text() for name in names)))


def test_the_codes_are_found():
    assert {"not_observable", "large_residual", "misaligned", "orbit_old"} <= codes(verdict)


def test_every_reason_of_a_verdict_says_what_to_do():
    assert codes(verdict) - {"observable"} <= words("how-to/when-it-says-refuse.md")


def test_every_reason_of_a_verdict_has_its_threshold_explained():
    assert codes(verdict) - {"observable"} <= words("calibration.md")


@pytest.mark.parametrize("module", [monitoring, suspicions])
def test_every_other_code_is_documented(module):
    found = set(re.findall(r'"(\w+_(?:suspect|mismatch))"', inspect.getsource(module))) | codes(module)
    assert found
    assert found - words("trust.md", "calibration.md") == set()

"""`magcal convert`: conventions in and out, from the places where parameters are kept."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from app.cli.main import magcal

TABLE_1 = {"bias_nt": [2928.125, -1191.25, -1875.625], "scale": [1.032695, 1.006685, 1.032875]} | {
    "nonorthogonality_deg": [-4.53, -1.067, 7.915]
}
CONVENTIONS = ["exact", "first-order", "symmetric", "lower-triangular", "a-matrix", "on-board"]


def convert(*args: str, stdin: str | None = None) -> Result:
    return CliRunner().invoke(magcal, ["convert", *args], input=stdin)


def test_the_papers_first_order_parameters_become_the_exact_ones() -> None:
    """DEKART, Table 1, printed to 1e-6: the exact parameters as derived for the specification of this project."""
    done = convert("-", "--from", "first-order", "--to", "exact", "--json", stdin=json.dumps(TABLE_1))
    exact = json.loads(done.stdout)
    np.testing.assert_allclose(exact["scale"], [1.036402, 1.019902, 1.043341], atol=1e-6)
    np.testing.assert_allclose(exact["nonorthogonality_deg"], [-4.729, -1.715, 7.940], atol=6e-4)
    assert exact["bias_nt"] == TABLE_1["bias_nt"]
    assert exact["convention"] == "exact"


@pytest.mark.parametrize("target", CONVENTIONS)
def test_there_and_back_loses_nothing(target: str) -> None:
    there = convert("-", "--to", target, "--json", stdin=json.dumps(TABLE_1))
    back = json.loads(convert("-", "--from", target, "--to", "exact", "--json", stdin=there.stdout).stdout)
    for name, value in TABLE_1.items():
        np.testing.assert_allclose(back[name], value, rtol=1e-12)


def test_a_parameter_set_is_read_as_it_was_printed(tmp_path: Path) -> None:
    path = tmp_path / "set.json"
    path.write_text(json.dumps({"verdict": {}, "parameters": TABLE_1 | {"time_offset_s": None, "regressors": {}}}))
    done = convert(str(path), "--to", "lower-triangular", "--json")
    np.testing.assert_allclose(json.loads(done.stdout)["matrix"][0], [1.032695, 0.0, 0.0], rtol=1e-12)
    assert convert(str(path), "--from", "symmetric", "--to", "exact").exit_code == 2


def test_people_get_a_table() -> None:
    done = convert("-", "--to", "symmetric", stdin=json.dumps(TABLE_1))
    assert done.exit_code == 0
    assert "symmetric parameters" in done.stdout
    assert done.stdout.count("matrix") == 3


@pytest.mark.parametrize("option", ["--from", "--to"])
def test_an_unknown_convention_is_wrong_usage(option: str) -> None:
    done = convert("-", "--to", "exact", option, "twostep", stdin=json.dumps(TABLE_1))
    assert done.exit_code == 2
    assert "lower-triangular" in done.stderr

"""`magcal calibrate` and `simulate` with indices and coefficient files."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from app.cli.calibrate import command as calibrate
from app.cli.simulate import command as simulate
from app.records.parameter_set import parse_parameter_set
from app.reporting import figures
from app.reporting.report import command_line, render_report
from magcal_core.errors import IndexFormatError, IndexMissingError, IndexRangeError
from magcal_core.pipeline import calibrate as run
from magcal_core.telemetry import read_samples

DATA = Path(__file__).resolve().parents[2] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())


def called(command, *args):
    return CliRunner().invoke(command, [str(arg) for arg in args], catch_exceptions=False)


def test_calibrate_takes_indices_and_says_so_in_the_record(tmp_path):
    case = CASES["calibrations"][0]
    want = next(run for run in case["runs"] if run["field"] == "igrf-14+rc")
    index, dst = DATA / want["index"], DATA / "dst_2024-05.txt"
    found = called(calibrate, DATA / case["file"], "--field", "igrf-14+rc", "--index", index, "--index", dst, "--json")
    record = json.loads(found.stdout)
    np.testing.assert_allclose(record["parameters"]["scale"], want["scale"], atol=2e-6)
    assert record["field_model"] == "igrf-14+rc"
    assert [one["name"] for one in record["provenance"]["indices"]] == ["RC"]
    assert record["provenance"]["options"]["index_gap"] == "refuse"
    assert record["external_index"]["name"] == "RC"
    parsed = parse_parameter_set(json.dumps(record))
    assert "--index INDEX" in command_line(parsed)
    weak = called(calibrate, DATA / case["file"], "--index", index)
    assert "storm" in weak.stdout
    assert "weak" in weak.stdout


def test_a_fault_of_an_index_names_its_file():
    session = DATA / CASES["calibrations"][0]["file"]
    with pytest.raises(IndexFormatError) as caught:
        called(calibrate, session, "--index", DATA / "bad_value.csv")
    assert "bad_value.csv: 1 fault" in caught.value.message
    with pytest.raises(IndexMissingError):
        called(calibrate, session, "--field", "igrf-14+dst")
    quiet = DATA / "rc_2021-02.csv"
    with pytest.raises(IndexRangeError):
        called(calibrate, session, "--field", "igrf-14+rc", "--index", quiet)
    found = called(calibrate, session, "--field", "igrf+rc", "--index", quiet, "--index-gap", "mean", "--json")
    assert json.loads(found.stdout)["external_field"]["mean_samples"] == 480
    unknown = called(calibrate, session, "--field", "igrf-14+kp")
    assert unknown.exit_code == 2
    assert "igrf-14+rc" in unknown.output


def test_what_simulate_makes_with_an_index_calibrate_finds_again(tmp_path):
    state = tmp_path / "state.json"
    state.write_text(
        json.dumps(
            {
                "epoch": "2024-05-10T18:00:00Z",
                "frame": "GCRF",
                "position_km": [6861.897826, -934.3811016, -14.66851920],
                "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
            }
        )
    )
    out, index = tmp_path / "pass.csv", DATA / "rc_2024-05.dat"
    given = ["--field", "igrf-14+rc", "--index", index]
    called(simulate, "--state", state, "--duration", 6000, "--step", 20, *given, "--noise", 1, "-o", out)
    truth = json.loads((tmp_path / "pass.csv.truth.json").read_text())
    assert (truth["field_model"], truth["external_field"]["kind"]) == ("igrf-14+rc", "rc")
    right = json.loads(called(calibrate, out, "--state", state, *given, "--json").stdout)
    wrong = json.loads(called(calibrate, out, "--state", state, "--json").stdout)
    errors = [np.abs(np.array(record["parameters"]["scale"]) - 1.0).max() for record in (right, wrong)]
    assert errors[0] < 2e-4 < errors[1]
    file = ["--field", "igrf-14+file", "--field-file", DATA / "core.shc"]
    refused = called(simulate, "--state", state, "--duration", 60, *file, "-o", out)
    assert refused.exit_code == 2
    assert "no degree above 13" in refused.output


def test_the_index_is_a_strip_below_the_residuals():
    case = CASES["calibrations"][0]
    found = run(read_samples(DATA / case["file"]), index=DATA / "rc_2024-05.dat")
    series = figures.IndexSeries.of_record(found.extras)
    assert series is not None
    assert (series.name, len(series.t_utc)) == ("RC", 5)
    drawn = figures.residual_time(found.residuals, index=series)
    assert [trace.name for trace in drawn.data if trace.yaxis == "y2"] == ["RC"]
    plain = figures.residual_time(found.residuals)
    assert all(trace.yaxis in (None, "y") for trace in plain.data)
    assert figures.IndexSeries.of_record({}) is None


def test_the_report_shows_the_index(tmp_path):
    case = CASES["calibrations"][0]
    path = tmp_path / "set.json"
    called(calibrate, DATA / case["file"], "--index", DATA / "rc_2024-05.dat", "-o", path)
    found = run(read_samples(DATA / case["file"]), index=DATA / "rc_2024-05.dat")
    page = render_report(parse_parameter_set(path.read_bytes()), found.residuals)
    assert "the index RC of the external field" in page

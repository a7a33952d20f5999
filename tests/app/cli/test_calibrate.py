"""`magcal calibrate`: files in, parameter set out, with the exit statuses that scripts rely on."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result

from app.cli.main import magcal
from magcal_core.sensor.model import SensorModel
from magcal_core.telemetry import read_samples, write_samples

PLAIN = [
    "--robust", "none", "--noise-model", "none", "--time-offset", "none",
    "--locked-terms", "none", "--bias-steps", "none",
]  # fmt: skip
SCALAR = ["--method", "scalar", *PLAIN]
"""The plain fit of |B|, which the figures of an independent one are of."""
BRO4_READING = {"time": "ts", "bx": "extmag_0", "by": "extmag_1", "bz": "extmag_2"}
BRO4_REFERENCE = {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}


def calibrate(*args: object, stdin: bytes | None = None) -> Result:
    return CliRunner().invoke(magcal, ["calibrate", *map(str, args)], input=stdin)


def parameter_set(*args: object, stdin: bytes | None = None) -> dict[str, object]:
    done = calibrate(*args, "--json", stdin=stdin)
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert isinstance(record, dict)
    return record


def test_the_set_in_force_is_compared(nominal, tmp_path):
    """The same telemetry under another sensor's parameters: the bias of axis 1 is 2000 nT off."""
    own = tmp_path / "own.json"
    own.write_text(json.dumps(parameter_set(nominal)))
    same = parameter_set(nominal, "--active", own)
    assert same["agreement"]["differs"] is False
    other = json.loads(own.read_text())
    other["parameters"]["bias_nt"][0] += 2000.0
    own.write_text(json.dumps(other))
    record = parameter_set(nominal, "--active", own)
    assert record["agreement"]["differences"][0]["parameter"] == "bias_nt[0]"
    assert record["verdict"]["reasons"][0].startswith("differs_from_active")


@pytest.fixture(scope="module")
def nominal(data_dir: Path) -> Path:
    return data_dir / "calibration" / "nominal.csv"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory, data_dir: Path) -> Path:
    """One orbit of DEKART without reference columns, noise 100 nT, with its truth beside it."""
    out = tmp_path_factory.mktemp("simulated") / "pass.csv"
    orbit = ["--tle", str(data_dir / "dekart.tle.txt"), "--start", "2022-02-19T22:37:44.130Z", "--duration", "7000"]
    sensor = ["--bias", "2928,-1191,-1875", "--scale", "1.03,1.007,1.033", "--eps", "-4.53,-1.067,7.915"]
    args = ["simulate", *orbit, *sensor, "--noise", "100", "--seed", "11", "-o", str(out)]
    assert CliRunner().invoke(magcal, args).exit_code == 0
    return out


@pytest.mark.parametrize(
    ("method", "answer"), [("scalar", "scalar_lm"), ("vector", "forward_ml"), ("vector-closed-form", "ols_inverse")]
)
@pytest.mark.parametrize("case", ["nominal", "outliers"])
def test_worked_cases_come_out_as_their_answers_say(case: str, method: str, answer: str, data_dir: Path) -> None:
    """An independent implementation's minimiser, to the 1e-6 that its answers promise."""
    folder = data_dir / "calibration"
    expected = json.loads((folder / f"{case}.answer.json").read_text())["expected"][answer]
    found = parameter_set(folder / f"{case}.csv", "--method", method, *PLAIN)["parameters"]
    assert isinstance(found, dict)
    for theirs, ours in (("k", "scale"), ("eps_deg", "nonorthogonality_deg"), ("b_nT", "bias_nt")):
        want = np.array(expected[theirs])
        np.testing.assert_array_less(np.abs(np.array(found[ours]) - want), 1e-6 * np.maximum(1.0, np.abs(want)))


def test_the_parameter_set_has_every_field_of_the_record(nominal: Path) -> None:
    record = parameter_set(nominal)
    assert {
        "status", "verdict", "created_at", "data_from", "data_until", "method", "field_model", "orbit_model",
        "parameters", "standard_errors", "parameter_names", "covariance", "formal_standard_errors", "matrix",
        "correction_matrix", "candidates", "statistics", "observability", "warnings", "provenance",
    } <= set(record)  # fmt: skip
    provenance = record["provenance"]
    assert isinstance(provenance, dict)
    assert provenance["inputs"][0]["quality"]["used"] == 575
    assert len(provenance["inputs"][0]["sha256"]) == 64
    assert provenance["options"]["method"] == "scalar"
    assert record["data_from"] == "2022-02-19T22:37:44.130000Z"


def test_a_simulated_pass_gives_its_truth_back(simulated: Path, data_dir: Path) -> None:
    """Each parameter within four of its own standard errors: one run in 1,700 strays further by chance."""
    truth = json.loads(simulated.with_name("pass.csv.truth.json").read_text())["parameters"]
    for method in ("scalar", "vector"):
        record = parameter_set(simulated, "--tle", data_dir / "dekart.tle.txt", "--method", method)
        found, errors = record["parameters"], record["standard_errors"]
        assert isinstance(found, dict)
        assert isinstance(errors, dict)
        for name in ("bias_nt", "scale", "nonorthogonality_deg"):
            np.testing.assert_array_less(np.abs(np.subtract(found[name], truth[name])), 4.0 * np.array(errors[name]))
        assert record["orbit_model"] == "sgp4"


def test_several_orbits_are_given_and_the_nearest_one_is_used(simulated: Path, data_dir: Path, tmp_path: Path) -> None:
    tles = (data_dir / "dekart.tle.txt").read_text().splitlines(keepends=True)
    near, far = tmp_path / "near.txt", tmp_path / "far.txt"
    near.write_text("".join(tles[:3]))
    far.write_text("".join(tles[3:]))
    want = parameter_set(simulated, "--tle", near)
    for given in (["--tle", far, "--tle", near], ["--tle", near, "--orbit-file", far], ["--orbit-file", near]):
        assert parameter_set(simulated, *given)["parameters"] == want["parameters"]


def test_units_and_column_names_of_the_file_are_mapped(nominal: Path, tmp_path: Path) -> None:
    want = parameter_set(nominal)["parameters"]
    samples = read_samples(nominal)
    own = tmp_path / "own.csv"
    lines = write_samples(samples, "csv").decode().replace("time,bx,by,bz,", "ts,m0,m1,m2,", 1).splitlines()
    rows = [line.split(",") for line in lines[1:]]
    scaled = [[row[0], *(repr(float(cell) / 1000.0) for cell in row[1:4]), *row[4:]] for row in rows]
    own.write_text("\n".join([lines[0], *(",".join(row) for row in scaled)]))
    columns = {"time": "ts", "bx": "m0", "by": "m1", "bz": "m2"}
    mapping = tmp_path / "columns.json"
    mapping.write_text(json.dumps(columns))
    for given in (json.dumps(columns), mapping):
        found = parameter_set(own, "--unit", "uT", "--columns", given)["parameters"]
        assert isinstance(found, dict)
        assert isinstance(want, dict)
        np.testing.assert_allclose(found["bias_nt"], want["bias_nt"], rtol=1e-9)


def test_telemetry_may_come_in_pieces_and_on_stdin(nominal: Path, tmp_path: Path) -> None:
    want = parameter_set(nominal)
    lines = nominal.read_text().splitlines(keepends=True)
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    first.write_text("".join(lines[:300]))
    second.write_text("".join([lines[0], *lines[290:]]))
    pieces = parameter_set(second, first)
    piped = parameter_set("-", stdin=nominal.read_bytes())
    assert pieces["parameters"] == piped["parameters"] == want["parameters"]
    assert pieces["statistics"] != want["statistics"], "ten rows stand in both pieces and are counted as left out"


def test_people_get_verdict_parameters_and_residuals(nominal: Path) -> None:
    done = calibrate(nominal)
    assert done.exit_code == 0
    assert done.stdout.startswith("accept  scalar, 575 samples")
    for text in ("bias 1, nT", "1 sigma", "before", "after", "cross-validated rms"):
        assert text in done.stdout


def test_residuals_and_the_parameter_set_go_to_files(nominal: Path, tmp_path: Path) -> None:
    residuals, output = tmp_path / "residuals.parquet", tmp_path / "set.json"
    done = calibrate(nominal, "--residuals", residuals, "-o", output)
    assert done.exit_code == 0, done.output
    table = pq.read_table(residuals)
    assert len(table) == 575
    rms_nt = np.sqrt(np.mean(np.square(table.column("residual_nt").to_pylist())))
    record = json.loads(output.read_text())
    np.testing.assert_allclose(rms_nt, record["statistics"]["after"]["rms_nt"], rtol=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        ["--method", "twostep"],
        ["--unit", "gauss"],
        ["--columns", "nonsense"],
        ["--columns", '{"time": 5}'],
        ["--max-orbit-age-days", "-1"],
        ["--field", "wmm"],
        ["--residuals", "out.xlsx"],
        ["--tle", "no-such-file"],
    ],
    ids=str,
)
def test_wrong_usage_ends_with_status_two(wrong: list[str], nominal: Path) -> None:
    assert calibrate(nominal, *wrong).exit_code == 2


def test_an_on_board_correction_is_taken_back_before_the_fit(nominal: Path, tmp_path: Path) -> None:
    """The parameters that the raw readings give, to rounding, and not the identity that the corrected ones give."""
    direct = parameter_set(nominal)
    old = SensorModel([2500.0, -1000.0, -1500.0], [1.02, 1.01, 1.03], [-4.0, -1.0, 7.0])
    document = direct | {
        "parameters": {
            "bias_nt": old.bias_nt.tolist(),
            "scale": old.scale.tolist(),
            "nonorthogonality_deg": old.nonorthogonality_deg.tolist(),
            "time_offset_s": None,
            "regressors": {},
        }
    }
    (tmp_path / "old.json").write_text(json.dumps(document))
    raw = read_samples(nominal)
    corrected = tmp_path / "corrected.csv"
    corrected.write_bytes(write_samples(replace(raw, h_nt=old.correct(raw.h_nt)), "csv"))
    found = parameter_set(corrected, "--corrected-with", tmp_path / "old.json")
    for name in ("bias_nt", "scale", "nonorthogonality_deg"):
        np.testing.assert_allclose(found["parameters"][name], direct["parameters"][name], rtol=1e-6, err_msg=name)
    untouched = parameter_set(corrected)["parameters"]
    assert abs(untouched["bias_nt"][0] - direct["parameters"]["bias_nt"][0]) > 1000.0
    inputs = found["provenance"]["inputs"]
    assert inputs[0]["corrected_with_sha256"] == hashlib.sha256((tmp_path / "old.json").read_bytes()).hexdigest()


def run_magcal(*args: object) -> subprocess.CompletedProcess[str]:
    code = "from app.cli.main import run; run()"
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_failed_work_ends_with_status_one_and_says_why_in_one_line(nominal: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    bare.write_text("\n".join(",".join(line.split(",")[:4]) for line in nominal.read_text().splitlines()))
    done = run_magcal("calibrate", bare)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("magcal: orbit_missing: ")
    assert done.stderr.count("\n") == 1


def test_every_fault_of_the_telemetry_gets_a_line(nominal: Path, tmp_path: Path) -> None:
    lines = nominal.read_text().splitlines()
    lines[3] = lines[3].replace(",", ",x", 1)
    lines[5] += ",1"
    broken = tmp_path / "broken.csv"
    broken.write_text("\n".join(lines))
    done = run_magcal("calibrate", broken, "--json")
    assert done.returncode == 1
    first, *faults = done.stderr.splitlines()
    assert first.startswith("magcal: telemetry_format: 2 faults in the CSV table")
    assert [fault.strip().split(":")[0] for fault in faults] == ["line 4, column bx", "line 6"]


@pytest.mark.real_data
def test_bro4_against_its_on_board_reference(bro4_dir: Path) -> None:
    """181.5 nT from 1367 nT, as an independent fit of the same 2371 samples has it."""
    columns = json.dumps(BRO4_READING | BRO4_REFERENCE)
    record = parameter_set(bro4_dir / "external.csv", "--columns", columns, "--unit", "mG", *SCALAR)
    statistics = record["statistics"]
    assert isinstance(statistics, dict)
    assert statistics["samples"] == 2371
    assert abs(statistics["after"]["rms_nt"] - 181.5) < 1.0
    assert abs(statistics["before"]["rms_nt"] - 1367.0) < 1.0


@pytest.mark.real_data
def test_bro4_with_a_tle_33_days_newer_warns_of_its_age(bro4_dir: Path) -> None:
    """423 nT: what a clock error of half a minute, which nobody estimates here, leaves."""
    reading = [bro4_dir / "external.csv", "--columns", json.dumps(BRO4_READING), "--unit", "mG"]
    tle = ["--tle", bro4_dir / "tle.txt"]
    record = parameter_set(*reading, *tle, "--max-orbit-age-days", 60, *SCALAR)
    statistics, warnings = record["statistics"], record["warnings"]
    assert isinstance(statistics, dict)
    assert isinstance(warnings, list)
    assert abs(statistics["after"]["rms_nt"] - 423.0) < 5.0
    assert any("tle_old" in warning and "33." in warning for warning in warnings)
    refused = run_magcal("calibrate", *reading, *tle)
    assert refused.returncode == 1
    assert refused.stderr.startswith("magcal: tle_epoch: ")

"""`magcal simulate`: what it writes, and that its truth is what a calibration finds."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from app.cli.main import magcal
from magcal_core.telemetry import read_samples

DEKART = [
    "--bias",
    "2928.125,-1191.25,-1875.625",
    "--scale",
    "1.032695,1.006685,1.032875",
    "--eps",
    "-4.53,-1.067,7.915",
]
ORBIT = ["--start", "2022-02-19T22:37:44.130Z", "--duration", "7000", "--step", "10"]


def simulate(*more: str) -> Result:
    return CliRunner().invoke(magcal, ["simulate", *ORBIT, *DEKART, *more])


@pytest.fixture
def tle(data_dir: Path) -> str:
    return str(data_dir / "dekart.tle.txt")


def test_telemetry_and_its_truth_are_written_side_by_side(tle: str, tmp_path: Path) -> None:
    out = tmp_path / "pass.csv"
    done = simulate("--tle", tle, "--noise", "100", "--seed", "4", "-o", str(out))
    assert done.exit_code == 0, done.output
    assert out.read_text().splitlines()[0] == "time,bx,by,bz,qw,qx,qy,qz"
    truth = json.loads((tmp_path / "pass.csv.truth.json").read_text())
    assert truth["parameters"]["bias_nt"] == [2928.125, -1191.25, -1875.625]
    assert truth["orbit"]["epoch"].startswith("2022-02-19"), "of two TLEs the one nearest to the start"
    assert len(read_samples(out)) == truth["samples"] == 700


def test_the_same_seed_gives_the_same_bytes(tle: str, tmp_path: Path) -> None:
    bodies = []
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        out = tmp_path / f"{name}.parquet"
        assert simulate("--tle", tle, "--noise", "50", "--seed", seed, "-o", str(out)).exit_code == 0
        bodies.append(out.read_bytes())
    assert bodies[0] == bodies[1] != bodies[2]


@pytest.mark.parametrize("name", ["pass.ndjson", "pass.json", "pass.csv.gz", "pass.parquet", "pass.ndjson.zst"])
def test_the_ending_tells_the_format(name: str, tle: str, tmp_path: Path) -> None:
    plain, out = tmp_path / "plain.csv", tmp_path / name
    simulate("--tle", tle, "-o", str(plain))
    assert simulate("--tle", tle, "-o", str(out)).exit_code == 0
    np.testing.assert_array_equal(read_samples(out).h_nt, read_samples(plain).h_nt)


def test_three_numbers_may_stand_apart(tle: str, tmp_path: Path) -> None:
    out = tmp_path / "pass.csv"
    apart = ["--bias", "2928.125", "-1191.25", "-1875.625", "--rate", "0.1", "-0.2", "0.3"]
    done = simulate("--tle", tle, *apart, "-o", str(out), "--json")
    assert done.exit_code == 0, done.output
    truth = json.loads(done.stdout)["truth"]
    assert truth["parameters"]["bias_nt"] == [2928.125, -1191.25, -1875.625]
    np.testing.assert_allclose(truth["attitude"]["rate_deg_s"], [0.1, -0.2, 0.3], rtol=1e-14)


def test_a_state_vector_serves_as_orbit(tmp_path: Path) -> None:
    """The paper's state of session 1, from which the TLE was recovered: their fields differ by the orbits' 450 m."""
    state = tmp_path / "state.json"
    r_km, v_km_s = [6861.897826, -934.3811016, -14.6685192], [-0.1222573311, -1.009655310, 7.525523775]
    epoch = {"epoch": "2022-02-19T22:37:44.130Z", "frame": "GCRF"}
    state.write_text(json.dumps({**epoch, "position_km": r_km, "velocity_km_s": v_km_s}))
    out = tmp_path / "pass.csv"
    done = simulate("--state", str(state), "-o", str(out))
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "pass.csv.truth.json").read_text())["orbit"]["model"] == "numerical"
    assert len(read_samples(out)) == 700


@pytest.mark.parametrize(
    "more",
    [
        [],
        ["--noise", "-1"],
        ["--noise", "many"],
        ["--bias", "1,2"],
        ["--outliers", "2"],
        ["--start", "2022-02-19T22:37:44"],
        ["--step", "0"],
        ["--field", "wmm"],
        ["-o", "pass.xlsx"],
    ],
    ids=str,
)
def test_wrong_usage_ends_with_status_two(more: list[str], tle: str, tmp_path: Path) -> None:
    orbit = ["--tle", tle] if more else []
    done = simulate(*orbit, "-o", str(tmp_path / "pass.csv"), *more)
    assert done.exit_code == 2, done.output

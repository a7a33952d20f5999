import csv
import json
import re

import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from magcal_core.attitude.options import RomOptions
from magcal_core.attitude.sweep import sweep_nonorthogonality

KEYS = {
    "settling_s",
    "final_error_deg",
    "max_error_last_two_orbits_deg",
    "max_rate_error_deg_s",
    "wheel_momentum_max_nms",
}
TABLE_1 = {
    "bias_nt": [2928.125, -1191.25, -1875.625],
    "scale": [1.032695, 1.006685, 1.032875],
    "nonorthogonality_deg": [-4.53, -1.067, 7.915],
}


def rom(*arguments):
    return CliRunner().invoke(magcal, ["rom", *arguments])


def test_json_has_the_summary_of_the_contract():
    """Figure 1 of the paper: below 5 deg at 3380 s, 3 %."""
    done = rom(
        "--altitude-km", "500", "--inclination-deg", "62", "--start", "110,-130,170", "--field", "dipole",
        "--kp", "0.05", "--kd", "20", "--duration-s", "10000", "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert set(summary) >= KEYS
    assert summary["settling_s"]["5"] == pytest.approx(3380.0, rel=0.03)
    assert set(summary["settling_s"]) == {"10", "5", "1"}


def test_a_level_that_is_never_reached_is_null():
    done = rom("--start", "110,-130,170", "--inclination-deg", "0", "--duration-s", "3000", "--json")
    assert json.loads(done.stdout)["settling_s"] == {"10": None, "5": None, "1": None}


def test_every_option_of_the_contract_is_taken():
    done = rom(
        "--altitude-km", "600", "--inclination-deg", "97.7", "--start", "10,20,30", "--turn", "40,50,60",
        "--field", "igrf", "--epoch", "2026-03-01T12:00:00Z", "--kp", "0.1", "--kd", "40", "--form", "printed",
        "--duration", "200", "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert set(json.loads(done.stdout)) >= KEYS


def test_angles_may_begin_with_a_minus_sign():
    assert rom("--start", "-70,-50,-10", "--duration-s", "100", "--json").exit_code == 0


def test_the_table_for_people_says_never_and_units():
    done = rom("--start", "110,-130,170", "--duration-s", "1000")
    assert done.exit_code == 0
    assert "never" in done.stdout
    assert "deg/s" in done.stdout


def test_a_sensor_file_may_be_a_parameter_set_or_its_parameters(tmp_path):
    (tmp_path / "set.json").write_text(json.dumps({"id": "a", "parameters": TABLE_1}))
    (tmp_path / "bare.json").write_text(json.dumps(TABLE_1))
    files = ["--sensor", str(tmp_path / "set.json")]
    base = ["--start", "10,10,10", "--duration-s", "12000", "--dt", "2", "--json"]
    raw = json.loads(rom(*base, *files).stdout)
    good = json.loads(rom(*base, *files, "--corrected-with", str(tmp_path / "bare.json")).stdout)
    assert raw["final_error_deg"] > 1.0
    assert good["final_error_deg"] < 1e-3


def test_series_are_written_every_ten_seconds(tmp_path):
    assert rom("--start", "10,20,30", "--duration-s", "100", "--series", str(tmp_path / "s.csv")).exit_code == 0
    rows = list(csv.DictReader((tmp_path / "s.csv").read_text().splitlines()))
    assert [row["time_s"] for row in rows] == [str(t) for t in range(0, 101, 10)]
    assert float(rows[0]["psi_deg"]) == pytest.approx(10.0, abs=1e-6)
    assert float(rows[0]["gamma_deg"]) == pytest.approx(30.0, abs=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [["--start", "1,2"], ["--start", "a,b,c"], ["--inclination-deg", "181"], ["--form", "x"], ["--field", "x"],
     ["--sensor", "nowhere.json"], ["--kp", "0"]],
)  # fmt: skip
def test_wrong_usage_has_exit_status_2(arguments):
    done = rom(*arguments)
    assert done.exit_code == 2
    assert "Error" in done.stderr


def test_help_explains_the_angles():
    done = rom("--help")
    assert done.exit_code == 0
    assert "psi about Y" in done.stdout


def test_the_plot_is_one_page_with_every_run_and_the_sweep(tmp_path):
    """Error per arcmin of non-orthogonality is 2.3' for equal signs, 3.0' for the worst (ROM, figure 4); 5 %."""
    for name in ("sensor", "set"):
        (tmp_path / f"{name}.json").write_text(json.dumps(TABLE_1))
    page = tmp_path / "rom.html"
    done = rom(
        "--start", "10,10,10", "--duration-s", "40000", "--dt", "2", "--sensor", str(tmp_path / "sensor.json"),
        "--corrected-with", str(tmp_path / "set.json"), "--plot", str(page), "--sweep-eps-arcmin", "0,10",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    found = [json.loads(text) for text in re.findall(r'class="figure">(.*?)</script>', page.read_text(), re.DOTALL)]
    assert [trace["name"] for figure in found for trace in figure["data"]] == [
        "this run",
        "raw",
        "equal signs",
        "worst signs",
    ]
    assert "src=" not in page.read_text().split("<script>", 1)[0]


def test_the_sweep_gives_the_published_slopes():
    """2.3' per arcmin for equal signs, 3.0' for the worst: 22.8' and 30.4' at 10' (ROM, figure 4); 5 %."""
    scenario = RomOptions.from_dict({"start": [10, 10, 10], "duration_s": 40_000, "dt_s": 2.0}).scenario()
    found = sweep_nonorthogonality(scenario, [0.0, 10.0])
    assert found.equal_arcmin == pytest.approx([0.0, 22.8], rel=0.05, abs=0.01)
    assert found.worst_arcmin == pytest.approx([0.0, 30.4], rel=0.05, abs=0.01)


def test_a_sweep_needs_a_plot():
    assert rom("--sweep-eps-arcmin", "1,2").exit_code == 2

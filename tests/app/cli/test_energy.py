"""`magcal energy` as users call it: its JSON, its table, its exit status."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from app.cli.main import magcal, run
from magcal_core.energy.forms import FORMS
from magcal_core.errors import ModelRangeError
from magcal_core.orbit.propagators.numerical import NumericalOrbit

STATE = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "GCRF",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}


@pytest.fixture
def state_file(tmp_path: Path) -> Path:
    path = tmp_path / "state.json"
    path.write_text(json.dumps(STATE))
    return path


def printed(*arguments: str | Path) -> dict[str, dict[str, float]]:
    done = CliRunner().invoke(magcal, ["energy", *map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    result: dict[str, dict[str, float]] = json.loads(done.stdout)
    return result


def test_json_has_the_balance_of_a_day(state_file: Path) -> None:
    """Published: std 0.019, peak to peak 0.072 m2/s2."""
    result = printed("--state", state_file, "--duration", "86400", "--step", "30")
    hamiltonian = result["hamiltonian"]
    assert hamiltonian["std_m2_s2"] == pytest.approx(0.0187, abs=3e-4)
    assert hamiltonian["peak_to_peak_m2_s2"] == pytest.approx(0.072, abs=1e-3)
    assert abs(hamiltonian["drift_m2_s2_per_day"]) < 0.1
    assert result["recovery"] is None
    for term in result["terms"].values():
        assert set(term) == {"mean", "std", "peak_to_peak"}  # type: ignore[arg-type]
    assert {"kinetic", "rotation", "tidal_work", "sun", "moon"} < set(result["terms"])


def test_forces_are_chosen_by_options(state_file: Path) -> None:
    fewer = printed("--state", state_file, "--duration", "7200", "--step", "60", "--no-third-bodies", "--degree", "4")
    assert "sun" not in fewer["terms"]
    assert fewer["terms"]["tidal_work"]["peak_to_peak"] == 0.0
    more = printed("--state", state_file, "--duration", "7200", "--step", "60", "--tide")
    assert "solid_tide_moon" in more["terms"]


def test_printed_form_shows_its_error(state_file: Path) -> None:
    result = printed("--state", state_file, "--duration", "86400", "--step", "30", "--form", "printed")
    assert result["hamiltonian"]["peak_to_peak_m2_s2"] == pytest.approx(1.263e5, rel=1e-3)


def test_recovery_is_printed_with_every_coefficient(state_file: Path) -> None:
    """One day at 560 km with 1 cm and 0.1 mm/s: about 6e-10 rms."""
    noise = ("--noise-position-m", "0.01", "--noise-velocity-m-s", "1e-4")
    arguments = ("--state", state_file, "--duration", "86400", "--step", "30", "--recover", "12", *noise)
    recovery = printed(*arguments, "--seed", "4")["recovery"]
    assert recovery["degree"] == 12
    assert 1e-10 < recovery["rms_error"] < 2e-9
    assert len(recovery["relative_error_by_degree"]) == 11  # type: ignore[arg-type]
    assert {"n", "m", "c", "s"} < set(recovery["coefficients"][0])  # type: ignore[index]
    assert printed(*arguments, "--seed", "4")["recovery"] == recovery
    assert printed(*arguments, "--seed", "5")["recovery"] != recovery


def test_a_tle_is_integrated_or_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "dekart.tle"
    path.write_text(
        "\n".join(
            (Path(__file__).resolve().parents[2] / "data" / "orbit" / "dekart.tle.txt").read_text().splitlines()[:3]
        )
        + "\n"
    )
    integrated = printed("--tle", path, "--duration", "7200", "--step", "60")
    assert integrated["hamiltonian"]["std_m2_s2"] < 0.1
    assert integrated["orbit_model"] == "numerical"
    sgp4 = printed("--tle", path, "--duration", "7200", "--step", "60", "--orbit", "sgp4")
    assert sgp4["hamiltonian"]["std_m2_s2"] > 100.0
    assert sgp4["warnings"][0].startswith("sgp4_velocity")  # type: ignore[index]


def oem_of_a_numerical_orbit() -> str:
    """An ephemeris of two hours, a state a minute, with the digits that such messages carry."""
    epoch = np.datetime64("2022-02-19T22:37:44.130", "ns")
    orbit = NumericalOrbit(epoch, STATE["position_km"], STATE["velocity_km_s"])  # type: ignore[arg-type]
    t_utc = epoch + np.arange(0, 7201, 60).astype("timedelta64[s]")
    lines = [
        "CCSDS_OEM_VERS = 2.0", "CREATION_DATE = 2022-02-20T00:00:00", "ORIGINATOR = TEST", "META_START",
        "OBJECT_NAME = DEKART", "OBJECT_ID = 2020-068H", "CENTER_NAME = EARTH", "REF_FRAME = GCRF", "TIME_SYSTEM = UTC",
        f"START_TIME = {t_utc[0]}", f"STOP_TIME = {t_utc[-1]}", "INTERPOLATION = HERMITE", "INTERPOLATION_DEGREE = 9",
        "META_STOP",
    ]  # fmt: skip
    for time, r_km, v_km_s in zip(t_utc, *orbit.state_gcrf(t_utc), strict=True):
        lines.append(" ".join([str(time), *(f"{x:.9f}" for x in r_km), *(f"{x:.12f}" for x in v_km_s)]))
    return "\n".join(lines) + "\n"


def test_an_ephemeris_is_balanced_over_its_whole_length(tmp_path: Path) -> None:
    """Interpolated between nodes a minute apart: H within 0.01 m2/s2; friction can only be estimated."""
    path = tmp_path / "dekart.oem"
    path.write_text(oem_of_a_numerical_orbit())
    result = printed("--oem", path, "--step", "60")
    assert result["samples"] == 121
    assert result["hamiltonian"]["std_m2_s2"] < 0.02
    assert result["warnings"][0].startswith("dissipation_estimated")  # type: ignore[index]
    beyond = CliRunner().invoke(magcal, ["energy", "--oem", str(path), "--duration", "9000"])
    assert isinstance(beyond.exception, ModelRangeError)


def test_series_are_written_as_csv(state_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "terms.csv"
    done = CliRunner().invoke(
        magcal, ["energy", "--state", str(state_file), "--duration", "600", "--step", "60", "--series", str(out)]
    )
    assert done.exit_code == 0, done.output
    assert "consistent" in done.output
    rows = list(csv.DictReader(out.read_text(encoding="utf-8").splitlines()))
    assert len(rows) == 11
    assert rows[1]["time"] == "2022-02-19T22:38:44.130000Z"
    first = {name: float(value) for name, value in rows[0].items() if name != "time"}
    assert first["hamiltonian_m2_s2"] == pytest.approx(
        first["kinetic_m2_s2"] + first["rotation_m2_s2"] - first["potential_m2_s2"], rel=1e-12
    )


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--state", "STATE", "--tle", "STATE"),
        ("--state", "STATE", "--degree", "40"),
        ("--state", "STATE", "--step", "0"),
        ("--state", "STATE", "--form", "best"),
        ("--state", "missing.json"),
    ],
)
def test_wrong_usage_ends_with_2(state_file: Path, arguments: tuple[str, ...]) -> None:
    own = [str(state_file) if part == "STATE" else part for part in arguments]
    assert CliRunner().invoke(magcal, ["energy", *own]).exit_code == 2


def test_a_state_that_is_none_ends_with_1_and_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps({**STATE, "frame": "NED"}))
    with pytest.raises(SystemExit) as ended:
        run(["energy", "--state", str(path)])
    assert ended.value.code == 1
    assert "orbit_format" in capsys.readouterr().err


def test_every_form_of_the_core_is_offered() -> None:
    shown = CliRunner().invoke(magcal, ["energy", "--help"]).output
    assert f"[{'|'.join(FORMS)}]" in shown


def test_the_plot_has_every_term_that_acts_and_the_recovery(state_file: Path, tmp_path: Path) -> None:
    page = tmp_path / "energy.html"
    arguments = ["--state", str(state_file), "--duration", "43200", "--step", "30", "--recover", "4", "--degree", "4"]
    done = CliRunner().invoke(magcal, ["energy", *arguments, "--plot", str(page)])
    assert done.exit_code == 0, done.output
    found = [json.loads(text) for text in re.findall(r'class="figure">(.*?)</script>', page.read_text(), re.DOTALL)]
    names = [[trace["name"] for trace in figure["data"]] for figure in found]
    assert {"hamiltonian", "kinetic", "sun", "moon", "tidal_work"} <= set(names[0])
    assert "dissipation" not in names[0]
    assert names[1] == ["signal", "error, least-squares"]
    assert found[1]["data"][0]["x"] is not None

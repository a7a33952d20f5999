"""`magcal calibrate` with telemetry whose form is declared, and what a user sees where it is not."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from app.cli.main import magcal, run
from magcal_core.orbit.messages.tle import checksum
from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text

OPTIONS = ["--robust", "none", "--noise-model", "none", "--time-offset", "none"]


@pytest.fixture(scope="module")
def samples() -> Samples:
    return simulated(SESSIONS[0], 300).samples


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, samples: Samples) -> Path:
    """The same session in several forms beside its TLE."""
    made = tmp_path_factory.mktemp("forms")
    (made / "orbit.tle").write_text(tle_text())
    ns = samples.t_utc.astype(np.int64)
    iso = [f"{np.datetime_as_string(t, unit='ns')}Z" for t in samples.t_utc]
    j2000_ns = ns - int(np.datetime64("2000-01-01T12:00", "ns").astype(np.int64))
    table(made / "plain.csv", "time,bx,by,bz", iso, samples.h_nt)
    table(made / "names.csv", "Timestamp [UTC],Magnetometer X,Magnetometer Y,Magnetometer Z", iso, samples.h_nt)
    table(made / "ms.csv", "time,bx,by,bz", ns // 10**6, samples.h_nt)
    table(made / "j2000.csv", "time,bx,by,bz", [f"{t // 10**9}.{t % 10**9:09d}" for t in j2000_ns], samples.h_nt)
    table(made / "counts.csv", "time,bx,by,bz", iso, samples.h_nt / 12.5)
    return made


def table(path: Path, head: str, times: object, h: np.ndarray) -> None:
    rows = (",".join([str(t), *map(repr, row)]) for t, row in zip(times, h.tolist(), strict=True))
    path.write_text("\n".join([head, *rows]) + "\n")


def calibrate(folder: Path, name: str, *args: str) -> Result:
    arguments = ["calibrate", str(folder / name), "--tle", str(folder / "orbit.tle"), *OPTIONS, "--json", *args]
    return CliRunner().invoke(magcal, arguments)


def bias(result: Result) -> list[float]:
    assert result.exit_code == 0, result.exception
    found: list[float] = json.loads(result.stdout)["parameters"]["bias_nt"]
    return found


@pytest.mark.parametrize(
    ("name", "args"),
    [
        ("ms.csv", ["--time-format", "unix-ms"]),
        ("j2000.csv", ["--time-format", "j2000"]),
        ("counts.csv", ["--unit", "counts", "--nt-per-count", "12.5"]),
        ("plain.csv", ["--fill", "-9.5", "--fill", "0.5"]),
    ],
)
def test_a_declared_form_gives_the_same_calibration(folder: Path, name: str, args: list[str]) -> None:
    """Milliseconds cut the time by up to 1 ms, 7.5 m along the orbit: some hundredths of a nanotesla."""
    np.testing.assert_allclose(bias(calibrate(folder, name, *args)), bias(calibrate(folder, "plain.csv")), atol=0.5)


def refused(folder: Path, name: str, capsys: pytest.CaptureFixture[str], *args: str) -> str:
    with pytest.raises(SystemExit) as caught:
        run(["calibrate", str(folder / name), "--tle", str(folder / "orbit.tle"), *args])
    assert caught.value.code == 1
    return capsys.readouterr().err


def test_what_is_not_declared_is_refused_with_the_form_that_suits_the_orbit(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "milliseconds since 1970? --time-format unix-ms (within three days of the orbit)" in refused(
        folder, "ms.csv", capsys
    )
    far = refused(folder, "j2000.csv", capsys)
    assert "10957.5 d from the telemetry" in far
    assert "J2000 seconds? --time-format j2000" in far


def test_the_map_that_is_proposed_reads_the_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(folder, "names.csv", capsys)
    assert "did you mean 'Magnetometer X'?" in said
    proposed = said[said.index("column map {") + len("column map ") : said.index("}") + 1]
    assert bias(calibrate(folder, "names.csv", "--columns", proposed)) == bias(calibrate(folder, "plain.csv"))


def test_a_value_does_not_reach_the_terminal_raw(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (folder / "plain.csv").read_text().splitlines()
    text[4] = text[4].rpartition(",")[0] + ",\x1b]0;owned\x07"
    (folder / "hostile.csv").write_text("\n".join(text))
    said = refused(folder, "hostile.csv", capsys)
    assert r"line 5, column bz: not a number: '\x1b]0;owned\x07'" in said
    assert "\x1b" not in said
    assert "\x07" not in said


def test_which_object_names_the_object_of_a_session(folder: Path) -> None:
    first, second = (next(line for line in tle_text().splitlines() if line.startswith(f"{kind} ")) for kind in "12")
    launch = ""
    for number, ahead_deg in ((50001, -1.0), (50002, 0.0), (50003, 1.0)):
        anomaly = (float(second[43:51]) + ahead_deg) % 360.0
        lines = (f"1 {number}{first[7:68]}", f"2 {number}{second[7:43]}{anomaly:8.4f}{second[51:68]}")
        launch += "".join(f"{line}{checksum(line)}\n" for line in lines)
    (folder / "launch.tle").write_text(launch)
    arguments = [
        "which-object",
        str(folder / "ms.csv"),
        "--tle",
        str(folder / "launch.tle"),
        "--time-format",
        "unix-ms",
    ]
    told = CliRunner().invoke(magcal, [*arguments, "--json"])
    assert told.exit_code == 0, told.exception
    record = json.loads(told.stdout)
    assert (record["state"], record["objects"][0]["norad_id"]) == ("told", "50002")
    assert "told: 50002 leaves" in CliRunner().invoke(magcal, arguments).stdout

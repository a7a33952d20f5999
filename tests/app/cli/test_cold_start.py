"""What commands load: time is not asserted, but that nothing is loaded that takes it."""

import subprocess
import sys
from pathlib import Path

import click
import pytest

from app.cli.main import COMMANDS, magcal
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

CALIBRATE = """
import contextlib, io, sys
from app.cli.main import run
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    run(["calibrate", *sys.argv[1:], "--json"])
print(sorted(sys.modules))
"""
HELP = """
import contextlib, io, sys
from app.cli.main import run
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    run([*sys.argv[1:], "--help"])
print(sorted(sys.modules))
"""
HEAVY = {
    "scipy.linalg", "scipy.special", "scipy.stats", "scipy.signal", "scipy.optimize", "pandas", "numpy.f2py",
    "pyarrow.parquet", "pyarrow.dataset", "pydantic", "fastapi", "sqlalchemy",
}  # fmt: skip
COMPILER = {
    "numba.np.arraymath", "numba.np.linalg", "numba.np.npyimpl", "numba.typed.typeddict", "numba.misc.cffiimpl",
    "numba.np.arrayobj", "numba.cpython.charseq", "numba.cpython.randomimpl",
}  # fmt: skip
"""Modules that numba compiles with: a kernel that is on the disk needs none of them."""
UNASKED = {
    "magcal_core.calibration.sessions.trend",
    "magcal_core.calibration.sessions.monitoring",
    "magcal_core.calibration.diagnosis.gyro_mounting",
    "magcal_core.field.index_files.read",
    "magcal_core.calibration.diagnosis.search",
    "magcal_core.calibration.estimators.vector",
    "magcal_core.calibration.estimators.hooke_jeeves",
    "magcal_core.calibration.uncertainty.bootstrap",
    "magcal_core.calibration.verdict.agreement",
    "magcal_core.orbit.messages.oem",
    "magcal_core.orbit.messages.omm",
    "magcal_core.telemetry.ndjson",
    "magcal_core.telemetry.parquet",
}
"""What a sound calibration by default, of a CSV and a TLE, does not use."""


def loaded(code: str, *arguments: str) -> set[str]:
    """Return the modules that a fresh process has loaded in the end."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.strip(" []\n").replace("'", "").split(", "))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the arguments of a default calibration of 700 clean samples."""
    folder: Path = tmp_path_factory.mktemp("cold")
    (folder / "telemetry.csv").write_bytes(write_samples(simulated(SESSIONS[0]).samples, "csv"))
    (folder / "orbit.tle").write_text(tle_text())
    return [str(folder / "telemetry.csv"), "--tle", str(folder / "orbit.tle")]


def test_a_cold_calibration_loads_neither_a_compiler_nor_what_it_does_not_use(files: list[str]) -> None:
    loaded(CALIBRATE, *files)  # its kernels are on the disk from here on
    modules = loaded(CALIBRATE, *files)
    assert "magcal_core.pipeline" in modules
    assert modules & (HEAVY | COMPILER | UNASKED) == set()


def commands() -> list[str]:
    """Return every command, and every command of a group, as it is typed."""
    found = [""]
    context = click.Context(magcal)
    for name in COMMANDS:
        found.append(name)
        command = magcal.get_command(context, name)
        if isinstance(command, click.Group):
            found += [f"{name} {inner}" for inner in command.list_commands(context)]
    return found


@pytest.mark.parametrize("command", commands())
def test_help_loads_nothing_that_computes_asks_or_stores(command: str) -> None:
    modules = loaded(HELP, *command.split())
    assert "click" in modules
    assert modules & ({"numpy", "numba", "pyarrow", "scipy", "erfa", "sgp4", "httpx2", "structlog"} | HEAVY) == set()

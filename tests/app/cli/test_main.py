"""The entry point itself."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from app.cli.main import magcal
from app.settings import Settings

SLOW = ("scipy.signal", "scipy.stats", "scipy.optimize", "scipy.interpolate", "pandas", "plotly", "apprise")


def started(**environment: str) -> str:
    """Return what a fresh process that has loaded the entry point, and not numpy, says of BLAS."""
    inherited = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    code = "import app.cli.main, os, sys; print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=inherited | environment, capture_output=True, text=True, check=True).stdout


def test_a_process_of_magcal_has_one_thread_of_blas_before_numpy_is_loaded() -> None:
    assert started() == "False 1\n"


def test_another_number_of_threads_is_left_as_it_is() -> None:
    assert started(OPENBLAS_NUM_THREADS="4") == "False 4\n"


@pytest.mark.parametrize("entry", ["magcal_core.pipeline", "app.main", "app.jobs.kinds.registry", "app.cli.calibrate"])
def test_what_every_start_loads_has_no_part_of_scipy_that_takes_seconds(entry: str) -> None:
    """`scipy.stats` and its kin take as long as all else together; who needs one imports it where it is used."""
    code = f"import {entry}, sys; print([one for one in {SLOW} if one in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(("workers", "url", "is_told"), [("2", True, True), ("0", True, False), ("2", False, False)])
def test_workers_that_a_server_over_postgresql_will_not_have_are_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, workers: str, url: bool, is_told: bool
) -> None:
    served: list[Settings] = []
    monkeypatch.setattr("app.server.serve", served.append)
    monkeypatch.setenv("MAGCAL_DATA_DIR", str(tmp_path))
    if url:
        monkeypatch.setenv("MAGCAL_DATABASE_URL", "postgresql://nobody@127.0.0.1:1/none")
    done = CliRunner().invoke(magcal, ["serve", "--workers", workers])
    assert done.exit_code == 0, done.output
    assert ("magcal worker" in done.stderr) is is_told
    assert [settings.workers for settings in served] == [int(workers)]

"""The entry point itself."""

import os
import subprocess
import sys


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

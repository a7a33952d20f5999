"""Kernels from the disk do what compiled ones do, and load none of what compiles them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = """
import numpy as np

from magcal_core.numerics.kernel import kernel


@kernel()
def doubled(values):
    out = np.zeros(values.size)
    for i in range(values.size):
        out[i] = 2.0 * values[i]
    return out


@kernel()
def summed(values):
    total = 0.0
    for value in doubled(values):
        total += value
    return total


@kernel()
def made(size):
    return np.zeros(size)


@kernel()
def refused(values):
    if values.size < 2:
        raise ValueError("too few")
    return values[1]
"""
CALL = """
import sys
import numpy as np
import kernels

values = np.array([1.0, 2.0, 4.0])
for name in sys.argv[1:]:
    function, argument = getattr(kernels, name), 3 if name == "made" else values
    found = function(argument)
    print(name, sum(function.stats.cache_hits.values()), np.asarray(found).tolist())
    if name in {"made", "refused"}:
        try:
            function(-1 if name == "made" else values[:1])
        except ValueError as error:
            print(error)
print("numba.np.arrayobj" in sys.modules)
"""
VALUES = {"doubled": "[2.0, 4.0, 8.0]", "summed": "14.0", "made": "[0.0, 0.0, 0.0]", "refused": "2.0"}
REFUSALS = {"made": ["negative dimensions not allowed"], "refused": ["too few"]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with kernels of which none is compiled."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    return tmp_path


def called(folder: Path, *names: str) -> list[str]:
    """Return what a fresh process prints that calls the kernels."""
    search = os.pathsep.join([str(folder), *sys.path])
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": search}
    command = [sys.executable, "-c", CALL, *names]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def expected(names: list[str], hits: int) -> list[str]:
    """Return the lines of kernels that were found ``hits`` times on the disk."""
    return [line for name in names for line in [f"{name} {hits} {VALUES[name]}", *REFUSALS.get(name, [])]]


def test_a_kernel_from_the_disk_gives_and_refuses_what_a_compiled_one_does(folder: Path) -> None:
    names = ["doubled", "made", "refused"]
    assert called(folder, *names) == [*expected(names, 0), "True"]
    assert called(folder, *names) == [*expected(names, 1), "False"]


def test_a_kernel_from_the_disk_becomes_part_of_one_that_is_compiled(folder: Path) -> None:
    called(folder, "doubled")
    assert called(folder, "doubled", "summed")[:2] == [*expected(["doubled"], 1), *expected(["summed"], 0)]
    assert called(folder, "summed") == [*expected(["summed"], 1), "False"]

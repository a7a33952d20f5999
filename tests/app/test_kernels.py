"""Kernels that an image brings along are used as they are, whatever the processor is called."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import app
from app.kernels import bring_kernels

CPU = "x86-64-v3" if platform.machine() in {"x86_64", "AMD64"} else "generic"
MODULE = """
from magcal_core.numerics import kernel as kernels

@kernels.kernel()
def kernel(x):
    return 2.0 * x
"""
ROOT = Path(app.__file__).parents[1]
USE = """
from own import kernel
assert kernel(1.5) == 3.0
name, features = kernel.targetctx.codegen().magic_tuple()[1:3]
print(sum(kernel.stats.cache_hits.values()), sum(kernel.stats.cache_misses.values()), name, repr(features))
"""


def use(folder: Path, cache: Path, **more: str) -> str:
    """Return hits, misses and processor of a fresh process that calls the kernel."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", **more}
    command = [sys.executable, "-c", USE]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_kernels_compiled_for_a_baseline_are_used_from_a_copy(tmp_path, monkeypatch):
    (tmp_path / "own.py").write_text(MODULE)
    built, cache = tmp_path / "built", tmp_path / "cache"
    baseline = {"NUMBA_CPU_NAME": CPU, "NUMBA_CPU_FEATURES": ""}
    assert use(tmp_path, built, **baseline) == f"0 1 {CPU} ''"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    assert bring_kernels(built) == len(list(built.rglob("*.nb?"))) == 2
    assert bring_kernels(built) == 0
    assert use(tmp_path, cache, **baseline) == f"1 0 {CPU} ''"
    assert not [path for path in cache.rglob("*") if path.is_file() and path.suffix not in {".nbi", ".nbc"}]
    assert use(tmp_path, cache).startswith("0 1 "), "a process of another processor compiles its own"


def test_nothing_is_brought_where_nothing_came_along_or_numba_has_its_own_place(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    assert bring_kernels(tmp_path / "none") == 0
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    (tmp_path / "built").mkdir()
    assert bring_kernels(tmp_path / "built") == 0

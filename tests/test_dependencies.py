"""What the locks hold and what is installed: no version below a floor that an advisory has set (A14)."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
FLOORS = {"starlette": Version("1.3.1"), "python-multipart": Version("0.0.27")}
"""From the advisories in public trackers; python-multipart need not be there at all: bodies are read raw."""
LOCKS = ("requirements/run.txt", "requirements/dev.txt")


def entries(lock: str) -> list[str]:
    """Return the entries of a lock file, each with its hashes on one line."""
    lines = (ROOT / lock).read_text().replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.startswith("#")]


def pinned(lock: str) -> dict[str, Version]:
    """Return name -> version of what a lock holds."""
    wanted = (Requirement(one.partition("--hash")[0].strip()) for one in entries(lock))
    return {one.name: Version(next(iter(one.specifier)).version) for one in wanted}


@pytest.mark.parametrize("lock", LOCKS)
def test_no_lock_holds_a_version_below_an_advisory_floor(lock: str) -> None:
    found = pinned(lock)
    assert found["starlette"] >= FLOORS["starlette"]
    assert "python-multipart" not in found or found["python-multipart"] >= FLOORS["python-multipart"]


@pytest.mark.parametrize("lock", LOCKS)
def test_every_entry_of_a_lock_is_one_version_with_its_hashes(lock: str) -> None:
    assert entries(lock)
    for entry in entries(lock):
        assert re.match(r"[a-zA-Z0-9._-]+==[^ ;]+ ", entry), entry
        assert re.search(r" --hash=sha256:[0-9a-f]{64}", entry), entry


def test_nothing_below_an_advisory_floor_is_installed() -> None:
    installed = {one.name.lower().replace("_", "-"): Version(one.version) for one in metadata.distributions()}
    assert installed["starlette"] >= FLOORS["starlette"]
    assert "python-multipart" not in installed or installed["python-multipart"] >= FLOORS["python-multipart"]


def test_the_project_itself_asks_for_no_less_than_the_floor() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [Requirement(one) for one in project["dependencies"]]
    starlette = next(one for one in wanted if one.name == "starlette")
    assert not starlette.specifier.contains("1.3.0")
    assert starlette.specifier.contains("1.3.1")

"""With default settings nothing leaves the machine: a whole little mission, with every connection written down."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

MISSION = Path(__file__).with_name("mission_offline.py")
NEW_NETWORK = ["unshare", "--map-root-user", "--net"]
HERE = re.compile(r"""(\('(127\.[\d.]+|::1|localhost)', .*\)|'(127\.[\d.]+|::1|localhost|)'|'/.*'|b'.*'|None)""")
"""Loopback by address or name, and sockets of this machine's files."""


def can_cut() -> bool:
    """Return whether this machine lets a process have a network of its own."""
    return subprocess.run([*NEW_NETWORK, "true"], capture_output=True, check=False).returncode == 0


@pytest.mark.slow
def test_a_mission_with_default_settings_asks_nobody(tmp_path: Path) -> None:
    """Where the machine allows it the network is cut, too, so that what a hook cannot see fails."""
    cut = can_cut()
    command = [sys.executable, str(MISSION), str(tmp_path), *(["--cut"] if cut else [])]
    done = subprocess.run([*(NEW_NETWORK if cut else []), *command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout)
    assert found["is_cut"] or not cut
    assert found["verdict"]["grade"] in {"accept", "weak"}
    assert set(found["answers"].values()) == {200}
    assert min(found["sizes"].values()) > 10
    asked = (tmp_path / "asked").read_text().splitlines() if (tmp_path / "asked").exists() else []
    assert [one for one in asked if HERE.fullmatch(one.partition(" ")[2]) is None] == []
    assert (tmp_path / "started").read_text().count("\n") >= 2  # the server, and a worker's child


def test_the_recorder_sees_a_connection_and_a_look_up(tmp_path: Path) -> None:
    """The hook that the test above rests on tells what would fail it."""
    spec = importlib.util.spec_from_file_location("mission_offline", MISSION)
    assert spec is not None
    assert spec.loader is not None
    mission = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(mission)
    (tmp_path / "sitecustomize.py").write_text(
        mission.RECORDER.format(asked=str(tmp_path / "asked"), started=str(tmp_path / "started"))
    )
    code = (
        "import socket\n"
        "socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('127.0.0.1', 9))\n"
        "try: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('192.0.2.1', 9))\n"
        "except OSError: pass\n"
        "try: socket.getaddrinfo('catalogue.invalid', 443)\n"
        "except OSError: pass\n"
    )
    subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": str(tmp_path)}, check=True)
    asked = (tmp_path / "asked").read_text().splitlines()
    assert [HERE.fullmatch(one.partition(" ")[2]) is not None for one in asked] == [True, False, False]

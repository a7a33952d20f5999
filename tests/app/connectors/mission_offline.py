"""A little mission against a real `magcal serve` with default settings, in a process whose network is cut or recorded.

    python mission_offline.py FOLDER [--cut]

With ``--cut`` it has a network of its own, in which only loopback is: it raises that first. The server and all its
children write every connection and look-up of a name into FOLDER/asked, by an audit hook that Python itself calls.
What was found is printed as JSON.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import httpx2

from magcal_client import Client
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

RECORDER = """
import os, sys

def note(event, arguments):
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        told = arguments[1]
    elif event.startswith("socket.get"):
        told = arguments[0] if arguments else ""
    else:
        return
    with open({asked!r}, "a") as out:
        out.write(event + " " + repr(told) + "\\n")

sys.addaudithook(note)
with open({started!r}, "a") as out:
    out.write(" ".join(sys.argv) + "\\n")
"""
SIOCSIFFLAGS = 0x8914
IS_UP = 0x1 | 0x40
START_S = 240.0
LOOKS_OUT = ("192.0.2.1", 443)
"""An address of nobody (RFC 5737), which a cut network cannot be asked for."""


def raise_loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IS_UP))


def is_cut() -> bool:
    """Return whether this process has no way out."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        try:
            out.connect(LOOKS_OUT)
        except OSError:
            return True
    return False


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


def start(folder: Path, port: int) -> subprocess.Popen[bytes]:
    hooks = folder / "hooks"
    hooks.mkdir()
    places = {name: str(folder / name) for name in ("asked", "started")}
    (hooks / "sitecustomize.py").write_text(RECORDER.format(**places))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAGCAL_")}
    path = os.pathsep.join([str(hooks), environment.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment |= {"MAGCAL_DATA_DIR": str(folder / "data"), "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}
    magcal = Path(sys.executable).with_name("magcal")
    command = [magcal, "serve", "--port", str(port)]
    with (folder / "out").open("wb") as out, (folder / "log").open("wb") as log:
        return subprocess.Popen(command, env=environment, stdout=out, stderr=log)


def key_of(folder: Path, url: str, server: subprocess.Popen[bytes]) -> str:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and server.poll() is None:
        with contextlib.suppress(httpx2.HTTPError):
            if httpx2.get(f"{url}/readyz", trust_env=False).status_code == 200:
                lines = (folder / "out").read_text().splitlines()
                return next(line.partition(": ")[2] for line in lines if line.startswith("admin key: "))
        time.sleep(0.1)
    raise SystemExit((folder / "log").read_text()[-2000:])


def fly(url: str, key: str) -> dict[str, object]:
    """Return what became of a satellite: orbit, telemetry, calibration, activation; and of every page and document."""
    with Client(url, key) as client:
        client.create_satellite("dekart", norad_id="46493")
        client.create_magnetometer("dekart", "mgm-1", "nT")
        client.send_orbits("dekart", tle_text())
        telemetry = write_samples(simulated(SESSIONS[0], 300).samples, "csv")
        session = client.upload("dekart", "mgm-1", telemetry, "text/csv")
        found = client.calibrate([str(session["id"])], method="scalar")
        client.activate(str(found["id"]), force=True, reason="a test")
        documents = [f"/parameter-sets/{found['id']}/export?format=c", f"/parameter-sets/{found['id']}/report",
                     "/overview", "/attention", "/fleet"]  # fmt: skip
        sizes = {one: len(client.download(one)) for one in documents}
    pages = ["/", "/satellites/dekart", f"/sessions/{session['id']}", f"/parameter-sets/{found['id']}", "/jobs",
             "/docs", "/reasons", "/keys", "/metrics", "/healthz", "/readyz"]  # fmt: skip
    headers = {"authorization": f"Bearer {key}"}
    answers = {one: httpx2.get(f"{url}{one}", headers=headers, trust_env=False).status_code for one in pages}
    return {"verdict": found["verdict"], "sizes": sizes, "answers": answers}


def main() -> None:
    folder = Path(sys.argv[1])
    if "--cut" in sys.argv:
        raise_loopback()
    port = free_port()
    server = start(folder, port)
    try:
        url = f"http://127.0.0.1:{port}"
        found = fly(url, key_of(folder, url, server))
        time.sleep(2.0)
    finally:
        server.send_signal(signal.SIGTERM)
        server.wait()
    sys.stdout.write(json.dumps(found | {"is_cut": is_cut(), "status": server.returncode}))


if __name__ == "__main__":
    main()

"""The examples run as they stand."""

import json
import os
import runpy
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx2
import numpy as np
import pytest

from app.dashboard.schemas import HistoryRow
from app.demo.mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture(scope="module")
def telemetry() -> bytes:
    return write_samples(simulated(SESSIONS[0], 600).samples, "csv")


def test_the_notebook_without_a_server_finds_the_truth(tmp_path, monkeypatch, capsys):
    """The simulation's truth within four honest standard errors."""
    monkeypatch.chdir(tmp_path)
    cells = runpy.run_path(str(EXAMPLES / "calibrate_in_a_notebook.py"))
    found = cells["calibration"]
    off = np.abs(found.parameters.bias_nt - cells["truth"].bias_nt) / found.standard_errors.bias_nt
    assert off.max() < 4
    assert "accept" in capsys.readouterr().out
    assert "plate-before-after" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_notebook_with_a_service_ends_in_a_verdict(service, telemetry, tmp_path, monkeypatch, capsys):
    (tmp_path / "dekart.tle").write_text(tle_text())
    (tmp_path / "telemetry.csv").write_bytes(telemetry)
    monkeypatch.setenv("MAGCAL_URL", service.url)
    monkeypatch.setenv("MAGCAL_KEY", service.key("read", "ingest", "operate"))
    monkeypatch.setenv("MAGCAL_EXAMPLE_TLE", str(tmp_path / "dekart.tle"))
    monkeypatch.setenv("MAGCAL_EXAMPLE_TELEMETRY", str(tmp_path / "telemetry.csv"))
    cells = runpy.run_path(str(EXAMPLES / "calibrate_through_a_service.py"))
    cells["client"].__exit__()
    assert cells["found"]["verdict"]["grade"] == "accept"
    assert "session" in capsys.readouterr().out


class Unavailable(BaseHTTPRequestHandler):
    """A service that is there and has no time."""

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        body = json.dumps({"code": "busy", "detail": "busy: try again", "status": 422}).encode()
        self.send_response(422)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_said: object) -> None:
        pass


def push(folder: Path, satellite: str, url: str, key: str) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "MAGCAL_URL": url, "MAGCAL_KEY": key}
    command = [EXAMPLES / "push_passes.sh", folder, satellite, "mgm"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


def test_the_station_s_script_loses_nothing_and_sends_nothing_twice(service, api, satellite, telemetry, tmp_path):
    (tmp_path / "pass-1.csv").write_bytes(telemetry)
    (tmp_path / "pass-2.csv").write_text("time,bx,by,bz\nyesterday,1,2,3\n")
    (tmp_path / "pass-3.part").write_bytes(telemetry[:100])
    key = service.key("ingest", satellites=[satellite])
    busy = ThreadingHTTPServer(("127.0.0.1", 0), Unavailable)
    thread = threading.Thread(target=busy.serve_forever)
    thread.start()
    try:
        kept = push(tmp_path, satellite, f"http://127.0.0.1:{busy.server_port}", key)
    finally:
        busy.shutdown()
        thread.join()
        busy.server_close()
    assert kept.returncode == 1
    assert (tmp_path / "pass-1.csv").exists()

    sent = push(tmp_path, satellite, service.url, key)
    assert sent.returncode == 1, sent.stderr
    assert sorted(path.name for path in (tmp_path / "sent").iterdir()) == ["pass-1.csv"]
    assert "time" in (tmp_path / "refused" / "pass-2.csv.why").read_text()
    assert (tmp_path / "pass-3.part").exists()

    (tmp_path / "sent" / "pass-1.csv").rename(tmp_path / "pass-1.csv")
    assert push(tmp_path, satellite, service.url, key).returncode == 0
    assert len(api.get(f"/sessions?satellite={satellite}").json()["items"]) == 1


def test_every_column_of_the_grafana_dashboard_is_in_the_answer_that_it_asks_for(api):
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    paths = api.get("/../../openapi.json").json()["paths"]
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            path = target["url"].removeprefix("${url}").partition("?")[0].replace("${satellite}", "{satellite_id}")
            assert path in paths
            if path.endswith("/history"):
                assert {column["selector"] for column in target["columns"]} <= set(HistoryRow.model_fields)


def test_the_grafana_dashboard_s_calls_answer(api: httpx2.Client, satellite: str):
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            path = target["url"].removeprefix("${url}/api/v1").replace("${satellite}", satellite)
            assert "items" in api.get(path).raise_for_status().json()

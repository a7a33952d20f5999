"""The examples run as they stand."""

import json
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from app.cli.push import command
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
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


def test_the_readme_s_own_telemetry_is_calibrated_as_it_says(tmp_path):
    """The commands as they are printed, by a shell, in a folder that has what a fresh clone and `make install` have."""
    blocks = re.findall(r"```sh\n(.*?)```", (EXAMPLES.parent / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    script = next(block for block in blocks if "magcal simulate" in block)
    for package in ("app", "magcal_core"):
        (tmp_path / package).symlink_to(EXAMPLES.parent / package)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "magcal").symlink_to(Path(sys.executable).with_name("magcal"))
    done = subprocess.run(["sh", "-e", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "accept" in done.stdout
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


def test_the_station_s_unit_calls_the_command_as_it_is():
    """systemd writes % as %%; the shell splits the instance's name at its colon."""
    unit = (EXAMPLES / "magcal-push@.service").read_text()
    line = next(line for line in unit.splitlines() if line.startswith("ExecStart="))
    program, flag, script, instance = shlex.split(line.removeprefix("ExecStart=").replace("%%", "%"))
    assert (program, flag, instance) == ("/bin/sh", "-c", "%i")
    said = script.replace("exec /opt/magcal/bin/magcal", "echo")
    done = subprocess.run([program, flag, said, "dekart:mgm-1"], capture_output=True, text=True, check=True)
    assert done.stdout == "push --watch /srv/passes/dekart:mgm-1 --satellite dekart --magnetometer mgm-1\n"
    assert {option.name for option in command.params} >= {"watch", "satellite", "magnetometer", "url", "key"}


def field_of(schema: dict, selector: str, components: dict) -> dict | None:
    """Return the schema of a field by its dotted name, None where the document has no such field."""
    for name in selector.split("."):
        options = [schema, *schema.get("anyOf", [])]
        options = [components[one["$ref"].rpartition("/")[2]] if "$ref" in one else one for one in options]
        if any(one.get("additionalProperties") for one in options):
            return {}  # a document of its own, such as a problem
        schema = next((one["properties"][name] for one in options if name in one.get("properties", {})), None)
        if schema is None:
            return None
    return schema


def test_every_column_of_the_grafana_dashboard_is_in_the_answer_that_it_asks_for(api):
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    document = api.get("/../../openapi.json").json()
    components = document["components"]["schemas"]
    for target in asked_by(dashboard):
        path = target["url"].removeprefix("${url}").partition("?")[0].replace("${satellite}", "{satellite_id}")
        answer = document["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]["schema"]
        item = field_of(answer, "items", components)["items"]
        for column in target["columns"]:
            assert field_of(item, column["selector"], components) is not None, (path, column["selector"])


def asked_by(dashboard: dict) -> list[dict]:
    """Return every query of a dashboard: of its panels, and of its variables."""
    panels = [target for panel in dashboard["panels"] for target in panel["targets"]]
    variables = [one["query"]["infinityQuery"] for one in dashboard["templating"]["list"] if one["type"] == "query"]
    return panels + variables


def test_the_grafana_dashboard_shows_one_magnetometer_at_a_time():
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    queries = {one["name"]: one["query"] for one in dashboard["templating"]["list"] if one["type"] == "query"}
    assert list(queries) == ["satellite", "magnetometer"]
    histories = [one["url"] for one in asked_by(dashboard) if "/history" in one["url"]]
    assert len(histories) == 8
    assert all(one.endswith("&magnetometer=${magnetometer}") for one in histories)


def test_the_grafana_dashboard_s_calls_answer(service, satellite: str):
    """With a key of one satellite: other tests leave sets in the shared service that no calibration has made."""
    dashboard = json.loads((EXAMPLES / "grafana-dashboard.json").read_text())
    with service.client(service.key("read", satellites=[satellite])) as api:
        for target in asked_by(dashboard):
            path = target["url"].removeprefix("${url}/api/v1").replace("${satellite}", satellite)
            answer = api.get(path.replace("${magnetometer}", "mgm"))
            assert answer.status_code == 200, answer.text
            assert "items" in answer.json()

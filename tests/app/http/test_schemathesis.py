"""The service under generated requests: every check of schemathesis, calls in a row, two keys.

`MAGCAL_FUZZ_SECONDS` says how long, in all; a minute here, an hour before a release. `MAGCAL_FUZZ_SEED` says with which
requests.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

SECONDS = int(os.environ.get("MAGCAL_FUZZ_SECONDS", "60"))
SEED = os.environ.get("MAGCAL_FUZZ_SEED", "1")
NOT_SAID_BY_A_SCHEMA = "positive_data_acceptance"
"""A schema cannot say what makes a checksum right, a cursor ours, or a place one where a field model holds."""
ENDLESS = r"/events$"
"""A stream of events ends with its job."""
OWN_KEY = r"/revoke$"
"""Revoking the key of the run would end the run; `tests/app/access` revokes keys."""


@pytest.fixture
def target(new_service):
    """A service with one of everything, and the identifiers of it."""
    service = new_service(workers=1, auth_failures_per_minute=1_000_000)
    with service.client() as admin:
        admin.post("/satellites", json={"id": "one"}).raise_for_status()
        admin.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        admin.post(
            "/satellites/one/orbits", content=tle_text(), headers={"content-type": "text/plain"}
        ).raise_for_status()
        content = write_samples(simulated(SESSIONS[0], 120).samples, "csv")
        sent = admin.post(
            "/satellites/one/sessions?magnetometer=mgm", content=content, headers={"content-type": "text/csv"}
        ).json()
        asked = admin.post("/jobs", json={"kind": "calibration", "session_ids": [sent["id"]]}).json()
        deadline = time.monotonic() + 90
        while (job := admin.get(f"/jobs/{asked['id']}").json())["state"] in {"queued", "running"}:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        ids = {
            "satellite_id": "one",
            "magnetometer_id": "mgm",
            "session_id": sent["id"],
            "job_id": job["id"],
            "parameter_set_id": job["result"]["parameter_set_id"],
        }
    return service, ids


def fuzz(service, ids: dict[str, str], key: str, seconds: int, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run schemathesis with ``key`` against the things named by ``ids``."""
    named = "\n".join(f'{name} = "{value}"' for name, value in ids.items())
    (folder / "schemathesis.toml").write_text(f"[parameters]\n{named}\n")
    command = [
        *(Path(sys.executable).parent / "schemathesis", "--config-file", folder / "schemathesis.toml", "run"),
        *(f"{service.url}/openapi.json", "--wait-for-schema", "60", "--request-timeout", "60"),
        *("--header", f"Authorization: Bearer {key}", "--checks", "all", "--exclude-checks", NOT_SAID_BY_A_SCHEMA),
        *(
            "--max-time",
            seconds,
            "--max-response-time",
            120,
            "--continue-on-failure",
            "--no-shrink",
            "--warnings",
            "off",
        ),
        *("--exclude-path-regex", f"({ENDLESS}|{OWN_KEY})", "--seed", SEED),
    ]
    return subprocess.run(
        [str(word) for word in command], cwd=folder, capture_output=True, check=False, text=True, timeout=seconds + 400
    )


@pytest.mark.slow
@pytest.mark.timeout(SECONDS + 600)
def test_no_generated_request_of_an_admin_breaks_a_promise_of_the_document(target, tmp_path):
    service, ids = target
    done = fuzz(service, ids, service.admin_key, max(1, SECONDS * 2 // 3), tmp_path)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.timeout(SECONDS + 600)
def test_no_generated_request_of_a_key_bound_elsewhere_reaches_or_breaks_anything(target, tmp_path):
    service, ids = target
    key = service.key("read", "ingest", "operate", satellites=["another"])
    with service.client() as admin:
        before = things_of_one(admin)
        done = fuzz(service, ids, key, max(1, SECONDS // 3), tmp_path)
        assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-2000:]
        assert things_of_one(admin) == before


def things_of_one(admin) -> list[dict]:
    """Return all that there is of the satellite ``one``; a key bound elsewhere may make jobs without a satellite."""
    lists = [admin.get(path, params={"satellite": "one"}).json() for path in ("/sessions", "/jobs", "/parameter-sets")]
    return [admin.get("/satellites/one").json(), *lists]

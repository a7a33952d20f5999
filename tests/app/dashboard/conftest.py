"""A satellite with a history, for whatever displays show."""

from __future__ import annotations

import time
from dataclasses import dataclass

import httpx2
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples


@dataclass(frozen=True)
class Mission:
    """Ids of a satellite, its session and the parameter sets made from it."""

    satellite: str
    session: str
    first: str
    second: str


@pytest.fixture(scope="session")
def mission(service) -> Mission:
    """One session, calibrated twice; the first set is in force, then the second."""
    with service.client() as api:
        api.post("/satellites", json={"id": "displayed"}).raise_for_status()
        api.post("/satellites/displayed/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        api.post("/satellites/displayed/orbits", content=tle_text(), headers={"content-type": "text/plain"})
        telemetry = write_samples(simulated(SESSIONS[0], 500).samples, "csv")
        path = "/satellites/displayed/sessions?magnetometer=mgm"
        session = api.post(path, content=telemetry, headers={"content-type": "text/csv"}).json()["id"]
        sets = [calibrated(api, session, method) for method in ("scalar", "vector")]
        for one in sets:
            api.post(f"/parameter-sets/{one}/activate").raise_for_status()
    return Mission("displayed", session, *sets)


def calibrated(api: httpx2.Client, session: str, method: str) -> str:
    body = {"kind": "calibration", "session_ids": [session], "method": method}
    job = api.post("/jobs", json=body).raise_for_status().json()
    deadline = time.monotonic() + 60
    while job["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline
        time.sleep(0.05)
        job = api.get(f"/jobs/{job['id']}").json()
    assert job["state"] == "succeeded", job
    return job["result"]["parameter_set_id"]

"""A mission that has something on every page: two magnetometers, a policy, a failure, a history to reprocess."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import httpx2
import numpy as np

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

SATELLITE = "dekart"
CSV = {"Content-Type": "text/csv"}
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Mission:
    """Where what it has made is shown: name of a page -> its address."""

    addresses: dict[str, str]


def ended(client: httpx2.Client, job: dict) -> dict:
    until = time.monotonic() + PATIENCE_S
    while job["state"] in {"queued", "running"} and time.monotonic() < until:
        time.sleep(0.2)
        job = client.get(f"/jobs/{job['id']}").raise_for_status().json()
    return job


def fly(client: httpx2.Client, rows: int = 700) -> Mission:
    """Fly two passes with two magnetometers, calibrate, activate, set a policy, reprocess; one job fails."""
    client.post("/satellites", json={"id": SATELLITE, "name": "DEKART", "norad_id": "46493"}).raise_for_status()
    for name in ("mgm-1", "mgm-2"):
        body = {"id": name, "unit": "nT", "noise_nt": 100.0}
        client.post(f"/satellites/{SATELLITE}/magnetometers", json=body).raise_for_status()
    tles = {"content": tle_text(), "headers": {"Content-Type": "text/plain"}}
    client.post(f"/satellites/{SATELLITE}/orbits", **tles).raise_for_status()
    sets, sessions = {}, {}
    for number, session in enumerate(SESSIONS):
        samples = simulated(session, rows).samples
        # The second sensor reads the same field with another gain and another offset.
        other = replace(samples, h_nt=samples.h_nt * 1.02 + [500.0, -300.0, 900.0])
        noisy = replace(other, h_nt=other.h_nt + np.random.default_rng(7).normal(0.0, 20.0, other.h_nt.shape))
        for name, sent in (("mgm-1", samples), ("mgm-2", noisy)):
            path = f"/satellites/{SATELLITE}/sessions?magnetometer={name}"
            answer = client.post(path, content=write_samples(sent, "csv"), headers=CSV).raise_for_status().json()
            sessions[name, number] = answer["id"]
    for name in ("mgm-1", "mgm-2"):
        for number in range(len(SESSIONS) if name == "mgm-1" else 1):
            body = {"kind": "calibration", "session_ids": [sessions[name, number]]}
            job = ended(client, client.post("/jobs", json=body).raise_for_status().json())
            sets[name, number] = job["result"]["parameter_set_id"]
        client.post(f"/parameter-sets/{sets[name, 0]}/activate", json={"reason": "flown"}).raise_for_status()
    policy = {"policy": {"calibrate": True, "method": "scalar", "robust": "tukey"}}
    client.patch(f"/satellites/{SATELLITE}/magnetometers/mgm-1", json=policy).raise_for_status()
    failing = {"kind": "calibration", "session_ids": [sessions["mgm-2", 1]], "max_orbit_age_days": 0.0001}
    ended(client, client.post("/jobs", json=failing).raise_for_status().json())
    body = {"satellites": [SATELLITE], "robust": "huber"}
    parent = client.post("/reprocessings", json=body).raise_for_status().json()
    ended(client, parent)
    return Mission(
        {
            "overview": "/",
            "wall": "/?display=wall",
            "satellite": f"/satellites/{SATELLITE}",
            "magnetometer": f"/satellites/{SATELLITE}/magnetometers/mgm-1",
            "magnetometers": f"/satellites/{SATELLITE}/magnetometers",
            "session": f"/sessions/{sessions['mgm-2', 1]}",
            "parameter-set": f"/parameter-sets/{sets['mgm-1', 1]}",
            "compare": f"/compare?first={sets['mgm-1', 0]}&second={sets['mgm-1', 1]}",
            "jobs": "/jobs",
            "reprocessings": "/reprocessings",
            "reprocessing": f"/reprocessings/{parent['id']}",
            "reasons": "/reasons",
            "keys": "/keys",
            "unknown": "/nothing-here",
        }
    )

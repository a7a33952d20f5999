"""A failure has its cause on the page: seen by an operator who opens the session, or the list of jobs."""

import time
from dataclasses import replace

import pytest
from playwright.sync_api import expect

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples
from tests.browser.conftest import Service, Watched

pytestmark = pytest.mark.browser
ENDED_S = 240.0


@pytest.fixture(scope="module")
def stuck(service: Service, tle: str) -> str:
    """A session with an axis that stands still, whose calibration has failed."""
    samples = replace(simulated(SESSIONS[0], 400).samples, q_base_gcrf=None)
    h_nt = samples.h_nt.copy()
    h_nt[:, 1] = h_nt[0, 1]
    with service.client() as client:
        client.post("/satellites", json={"id": "stuck"}).raise_for_status()
        client.post("/satellites/stuck/magnetometers", json={"id": "mgm-1", "unit": "nT"}).raise_for_status()
        client.post("/satellites/stuck/orbits", content=tle, headers={"Content-Type": "text/plain"}).raise_for_status()
        content = write_samples(replace(samples, h_nt=h_nt), "csv")
        path, headers = "/satellites/stuck/sessions?magnetometer=mgm-1", {"Content-Type": "text/csv"}
        session = str(client.post(path, content=content, headers=headers).raise_for_status().json()["id"])
        job = client.post("/jobs", json={"kind": "calibration", "session_ids": [session]}).raise_for_status().json()
        until = time.monotonic() + ENDED_S
        while job["state"] in {"queued", "running"} and time.monotonic() < until:
            time.sleep(0.2)
            job = client.get(f"/jobs/{job['id']}").json()
        assert job["state"] == "failed", job
    return session


def test_a_session_says_why_its_last_calibration_failed(window: Watched, stuck: str) -> None:
    page = window.open(f"/sessions/{stuck}")
    why = page.locator("#cause")
    expect(why).to_contain_text("Why the last calibration failed")
    expect(why).to_contain_text("Cause: axis_constant axis 2 is ")
    expect(why.get_by_role("link", name="job ")).to_be_visible()


def test_the_list_of_jobs_has_the_cause_behind_the_code(window: Watched, stuck: str) -> None:
    page = window.open("/jobs?q=stuck")
    row = page.get_by_role("row").filter(has=page.locator(f'a[href="/sessions/{stuck}"]'))
    expect(row.locator("summary")).to_have_text("wrong_input")
    expect(row).to_contain_text("Cause: axis_constant")

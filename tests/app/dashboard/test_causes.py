"""The cause of a failure stands on the session's page and on that of a refused set, before anything else is asked."""

from __future__ import annotations

import html
import json
import re
from dataclasses import dataclass, replace
from importlib import resources

import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples
from tests.app.dashboard.test_pages import sign_in, visitor  # noqa: F401 - a fixture
from tests.app.jobs.test_jobs import calibrate, send, wait

STATIC = {path.name: path.read_text() for path in (resources.files("app.dashboard") / "static").iterdir()}


@dataclass(frozen=True)
class Troubled:
    """A session whose calibration failed, and a set that is refused for its input."""

    session: str
    set_id: str


@pytest.fixture(scope="module")
def troubled(service, names) -> Troubled:
    """One session with an axis that stands still, one whose clock is 15 s ahead."""
    samples = replace(simulated(SESSIONS[0], 400).samples, q_base_gcrf=None)
    still = samples.h_nt.copy()
    still[:, 1] = still[0, 1]
    with service.client() as api:
        satellite = next(names)
        api.post("/satellites", json={"id": satellite}).raise_for_status()
        api.post(f"/satellites/{satellite}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
        stuck = send(api, satellite, write_samples(replace(samples, h_nt=still), "csv"))
        failed = wait(api, calibrate(api, [stuck]).json()["id"], timeout_s=240.0)
        assert failed["state"] == "failed", failed
        moved = replace(samples, t_utc=samples.t_utc + np.timedelta64(15, "s"))
        late = send(api, satellite, write_samples(moved, "csv"))
        refused = wait(api, calibrate(api, [late], time_offset="none").json()["id"], timeout_s=240.0)
        assert refused["state"] == "succeeded", refused
    return Troubled(stuck, refused["result"]["parameter_set_id"])


def brought(page: str) -> dict[str, dict]:
    found = re.findall(r'<script type="application/json" data-answer="([^"]+)">(.*?)</script>', page)
    return {html.unescape(path): json.loads(text) for path, text in found}


def test_the_page_of_a_session_brings_along_why_its_last_calibration_failed(visitor, service, troubled):  # noqa: F811
    sign_in(visitor, service.admin_key)
    answers = brought(visitor.get(f"/sessions/{troubled.session}").text)
    (job,) = answers[f"/jobs?kind=calibration&limit=1&session={troubled.session}"]["items"]
    assert job["state"] == "failed"
    cause = job["error"]["diagnosis"]["findings"][0]
    assert cause["code"] == "axis_constant"
    assert cause["text"].startswith("axis 2 is ")
    assert job["error"]["detail"].startswith("axis_constant: axis 2 is ")


def test_the_page_of_a_refused_set_brings_its_diagnosis_along(visitor, service, troubled):  # noqa: F811
    sign_in(visitor, service.admin_key)
    record = brought(visitor.get(f"/parameter-sets/{troubled.set_id}").text)[f"/parameter-sets/{troubled.set_id}"]
    assert record["verdict"]["grade"] == "refuse"
    assert record["verdict"]["reasons"][0].startswith("wrong_input_suspected: clock: ")
    assert record["diagnosis"]["findings"][0]["code"] == "clock"


@pytest.mark.parametrize(
    ("script", "shown"),
    [
        ("session.js", "causes(job.error.diagnosis)"),
        ("jobs.js", "causes(job.error.diagnosis)"),
        ("parameter_set.js", "causes(record.diagnosis)"),
        ("magcal.js", "causes(body.diagnosis)"),
    ],
)
def test_every_page_that_tells_of_a_failure_shows_its_causes(script, shown):
    assert shown in STATIC[script]

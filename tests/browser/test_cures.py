"""A reason has the button that mends it, and pages of sets and keys show what happens while they are open."""

from __future__ import annotations

import re
from dataclasses import replace

import httpx2
import numpy as np
import pytest
from playwright.sync_api import expect

from magcal_core.samples import Samples
from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples
from tests.browser.conftest import Service, Watched
from tests.browser.mission import CSV, ended

pytestmark = pytest.mark.browser
SATELLITE = "cures"
DRAWN_MS = 120_000
LIVE_MS = 20_000
"""A page that only asks once a minute would be late."""
PLAIN = {"robust": "none", "noise_model": "none", "time_offset": "none"}


def made(client: httpx2.Client, samples: Samples, **options: object) -> str:
    """Return the parameter set of a calibration of ``samples``."""
    path = f"/satellites/{SATELLITE}/sessions?magnetometer=mgm"
    session = client.post(path, content=write_samples(samples, "csv"), headers=CSV).raise_for_status().json()["id"]
    body = {"kind": "calibration", "session_ids": [session], **options}
    job = ended(client, client.post("/jobs", json=body).raise_for_status().json())
    return str(job["result"]["parameter_set_id"])


@pytest.fixture(scope="module")
def sets(service: Service, tle: str) -> dict[str, str]:
    """Name -> parameter set: of a session as it should be, one with a bad stretch, one whose clock keeps GPS time."""
    flown = replace(simulated(SESSIONS[0]).samples, q_base_gcrf=None)
    h_nt = flown.h_nt.copy()
    h_nt[280:455, 0] += 8000.0 * np.sin(np.arange(175) / 20.0)
    late = replace(flown, t_utc=flown.t_utc + np.timedelta64(18, "s"))
    with service.client() as client:
        client.post("/satellites", json={"id": SATELLITE}).raise_for_status()
        client.post(f"/satellites/{SATELLITE}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        text = {"Content-Type": "text/plain"}
        client.post(f"/satellites/{SATELLITE}/orbits", content=tle, headers=text).raise_for_status()
        return {
            "good": made(client, flown),
            "stretch": made(client, replace(flown, h_nt=h_nt)),
            "late": made(client, late, **PLAIN),
        }


@pytest.mark.parametrize(("name", "label"), [("stretch", r"Leave out \d\d:\d\d-\d\d:\d\d"), ("late", "As GPS time")])
def test_one_press_on_a_reason_leads_to_a_set_that_is_accepted(
    name: str, label: str, window: Watched, sets: dict[str, str]
) -> None:
    page = window.open(f"/parameter-sets/{sets[name]}")
    button = page.locator(".reason button").filter(has_text=re.compile(label)).first
    expect(button).to_be_visible(timeout=DRAWN_MS)
    button.click()
    page.wait_for_url(lambda url: "/parameter-sets/" in url and sets[name] not in url, timeout=DRAWN_MS)
    expect(page.locator(".verdict .word")).to_contain_text("accept", timeout=DRAWN_MS)


def test_open_pages_of_sets_show_which_one_comes_into_force(
    window: Watched, sets: dict[str, str], service: Service
) -> None:
    page = window.open(f"/parameter-sets/{sets['good']}")
    expect(page.get_by_role("button", name="Activate …")).to_be_visible(timeout=DRAWN_MS)
    expect(page.locator("#live")).to_contain_text("live")
    other = window.page.context.new_page()
    other.goto(f"{service.url}/compare?first={sets['good']}&second={sets['stretch']}")
    expect(other.locator(".pair")).to_contain_text("candidate")
    expect(other.locator("#live")).to_contain_text("live")
    page.bring_to_front()
    with service.client() as client:
        client.post(f"/parameter-sets/{sets['good']}/activate", json={}).raise_for_status()
    expect(page.get_by_role("button", name="Roll back …")).to_be_visible(timeout=LIVE_MS)
    expect(page.locator("h1 .badge")).to_have_text("active")
    other.bring_to_front()
    expect(other.locator(".pair")).to_contain_text("active", timeout=LIVE_MS)
    other.close()


def test_the_open_page_of_keys_shows_what_was_done_by_whom_and_to_what(
    window: Watched, sets: dict[str, str], service: Service
) -> None:
    page = window.open("/keys")
    trail = page.get_by_role("region", name="Audit trail")
    expect(trail.locator("tbody tr").first).to_be_visible()
    expect(page.locator("#live")).to_contain_text("live")
    before = trail.locator("a", has_text=sets["good"][-8:]).count()
    with service.client() as client:
        state = client.get(f"/parameter-sets/{sets['good']}").json()["status"]
        verb = "rollback" if state == "active" else "activate"
        client.post(f"/parameter-sets/{sets['good']}/{verb}", json={}).raise_for_status()
        names = {one["id"]: one["name"] for one in client.get("/keys").json()["items"]}
        (newest, *_) = client.get("/audit?limit=1").json()["items"]
    row = trail.locator("tbody tr").first
    expect(row).to_contain_text(f"parameter_set.{verb}", timeout=LIVE_MS)
    assert trail.locator("a", has_text=sets["good"][-8:]).count() == before + 1
    link = row.locator(f'a[href="/parameter-sets/{sets["good"]}"]')
    expect(link).to_be_visible()
    expect(row).to_contain_text(names[newest["key_id"]] or newest["key_id"])


def test_a_refused_set_comes_into_force_by_a_grey_button_and_with_a_reason_alone(
    window: Watched, sets: dict[str, str], service: Service
) -> None:
    with service.client() as client:
        found = {one: client.get(f"/parameter-sets/{one}").json()["verdict"]["grade"] for one in sets.values()}
    refused = next(one for one, grade in found.items() if grade == "refuse")
    page = window.open(f"/parameter-sets/{refused}")
    button = page.get_by_role("button", name="Activate although refused")
    expect(button).to_have_class("grey")
    button.click()
    dialog = page.get_by_role("dialog")
    put = dialog.get_by_role("button", name="Put the refused set in force")
    expect(put).to_have_class("grey")
    put.click()
    expect(dialog).to_be_visible()
    with service.client() as client:
        assert client.get(f"/parameter-sets/{refused}").json()["status"] != "active"
    dialog.get_by_label("Why it comes into force").fill("Nothing better until Thursday")
    put.click()
    expect(page.locator(".status-active")).to_be_visible()
    with service.client() as client:
        told = client.get("/audit", params={"q": "until thursday"}).json()["items"]
    assert [(one["action"], one["subject"]) for one in told] == [("parameter_set.activate", refused)]

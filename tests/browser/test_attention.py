"""An operator's walk: something goes wrong, the first page says so, two clicks mend it; all of it fits a phone."""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples
from tests.browser.conftest import Service, Watched, serve, sign_in, wait_until_quiet, watched

pytestmark = pytest.mark.browser
JOB_MS = 240_000


@pytest.fixture(scope="module")
def troubled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    yield from serve(tmp_path_factory.mktemp("troubled"))


@pytest.fixture
def desk(browser: Browser, troubled: Service) -> Iterator[Watched]:
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    found = watched(context, troubled)
    sign_in(found.page, troubled)
    yield found
    context.close()
    found.check()


def send(service: Service, satellite: str, samples: object) -> str:
    with service.client() as client:
        path = f"/satellites/{satellite}/sessions?magnetometer=mgm-1"
        content = write_samples(samples, "csv")
        sent = client.post(path, content=content, headers={"Content-Type": "text/csv"}).raise_for_status()
        return str(sent.json()["id"])


def add(service: Service, satellite: str, tle: str, norad_id: str) -> None:
    with service.client() as client:
        body = {"id": satellite, "name": satellite.title(), "norad_id": norad_id}
        client.post("/satellites", json=body).raise_for_status()
        client.post(f"/satellites/{satellite}/magnetometers", json={"id": "mgm-1", "unit": "nT"}).raise_for_status()
        path = f"/satellites/{satellite}/orbits?force=true"
        client.post(path, content=tle, headers={"Content-Type": "text/plain"}).raise_for_status()


def entry(page: Page, satellite: str, code: str) -> object:
    of = page.locator(f'.attention li[data-code="{code}"]')
    return of.filter(has=page.get_by_role("link", name=satellite, exact=True))


def test_a_wrong_orbit_is_said_and_withdrawn_in_two_clicks(desk: Watched, troubled: Service, tle: str) -> None:
    add(troubled, "heron", tle, "12345")
    page = desk.open("/")
    wrong = entry(page, "Heron", "orbit_other_object")
    expect(wrong).to_contain_text("TLE is of NORAD 46493, the satellite is 12345")
    assert int(page.locator(".counter.act").inner_text().split()[-1]) >= 1
    wrong.get_by_role("link", name="Choose orbit").click()
    rows = page.get_by_role("region", name="Orbits").locator("tbody tr")
    expect(rows.first).to_contain_text("46493, not 12345")
    for row in rows.all():
        row.get_by_role("button", name="Withdraw").click()
        expect(row.get_by_role("button", name="Restore")).to_be_visible()
    expect(page.locator('li[data-code="orbit_other_object"]')).to_have_count(0)


def test_a_disagreeing_session_is_said_and_mended_by_two_clicks(desk: Watched, troubled: Service, tle: str) -> None:
    """The first set by the same buttons; then the bias moves by 2,000 nT, which nobody has to ask for."""
    add(troubled, "lantern", tle, "46493")
    flown = simulated(SESSIONS[0], 800).samples
    send(troubled, "lantern", flown)
    page = desk.open("/")

    def mend(code: str) -> None:
        entry(page, "Lantern", code).get_by_role("button", name="Calibrate").click()
        activate = entry(page, "Lantern", code).get_by_role("button", name="Activate")
        expect(activate).to_be_visible(timeout=JOB_MS)
        activate.click()
        expect(entry(page, "Lantern", code)).to_have_count(0, timeout=JOB_MS)

    mend("no_active_set")
    moved = flown.h_nt + np.array([0.0, 2000.0, 0.0])
    send(troubled, "lantern", replace(flown, h_nt=moved))
    told = entry(page, "Lantern", "session_disagrees")
    expect(told).to_contain_text("disagrees with the set in force", timeout=JOB_MS)
    row = page.get_by_role("region", name="Satellites").locator("tbody tr", has_text="Lantern")
    expect(row.locator(".residual.refuse")).to_contain_text("times")
    mend("session_disagrees")
    expect(row.locator(".residual.accept")).to_be_visible(timeout=JOB_MS)


def test_a_failed_job_is_said_acknowledged_with_a_note_and_comes_back(
    desk: Watched, troubled: Service, tle: str
) -> None:
    add(troubled, "wader", tle, "46493")
    short = send(troubled, "wader", simulated(SESSIONS[0], 30).samples)
    with troubled.client() as client:
        job = client.post("/jobs", json={"kind": "calibration", "session_ids": [short]}).raise_for_status().json()
        until = time.monotonic() + JOB_MS / 1000
        while client.get(f"/jobs/{job['id']}").json()["state"] != "failed":
            assert time.monotonic() < until
            time.sleep(0.2)
    page = desk.open("/")
    failed = entry(page, "Wader", "job_failed").first
    expect(failed).to_contain_text("do not determine the parameters")
    failed.get_by_role("button", name="Acknowledge").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Note").fill("The next pass is longer.")
    dialog.get_by_role("button", name="Acknowledge").click()
    expect(page.locator("summary", has_text="acknowledged")).to_be_visible()
    page.locator("summary", has_text="acknowledged").click()
    expect(page.get_by_text("The next pass is longer.")).to_be_visible()


def test_the_fleet_is_searched_in_the_address_and_a_phone_needs_no_scrolling_sideways(
    browser: Browser, troubled: Service, tle: str
) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844})
    window = watched(context, troubled)
    sign_in(window.page, troubled)
    add(troubled, "plover", tle, "46493")
    page = window.open("/?q=plover")
    rows = page.get_by_role("region", name="Satellites").locator("tbody tr")
    expect(rows).to_have_count(1)
    page.get_by_label("Search Satellites").fill("nobody")
    expect(rows).to_have_count(0)
    assert "q=nobody" in page.url
    session = send(troubled, "plover", simulated(SESSIONS[0], 60).samples)
    for path in ("/", "/?display=wall", "/jobs", "/keys", "/reasons", "/satellites/plover", f"/sessions/{session}"):
        window.open(path)
        wait_until_quiet(page)
        width = page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
        assert width[0] <= width[1], path
    context.close()
    window.check()


def test_an_unknown_address_is_a_page_and_a_dark_page_prints_on_white(desk: Watched) -> None:
    page = desk.open("/nowhere")
    expect(page.get_by_role("heading", name="Not found")).to_be_visible()
    desk.errors.clear()  # Chromium itself reports the answer of 404 in the console
    desk.open("/jobs")
    page.evaluate("() => { document.documentElement.dataset.theme = 'dark'; }")
    background = "() => getComputedStyle(document.body).backgroundColor"
    assert page.evaluate(background) != "rgb(255, 255, 255)"
    page.emulate_media(media="print")
    assert page.evaluate(background) == "rgb(255, 255, 255)"
    assert page.evaluate("() => getComputedStyle(document.querySelector('h1')).color") == "rgb(0, 0, 0)"
    page.emulate_media(media="screen")

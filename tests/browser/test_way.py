"""The whole way by clicking: from an empty service to an activated parameter set, and back."""

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.conftest import Service, Watched, serve, sign_in, watched

pytestmark = pytest.mark.browser
JOB_MS = 60_000


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> object:
    yield from serve(tmp_path_factory.mktemp("empty"))


def upload(page: Page, file: Path) -> None:
    page.get_by_label("Drop telemetry here").set_input_files(file)
    expect(page.get_by_text(f"{file.name}: session")).to_be_visible(timeout=JOB_MS)


def calibrate(page: Page) -> None:
    page.locator("#calibrate").get_by_role("button", name="Calibrate", exact=True).click()
    page.wait_for_url(re.compile("/parameter-sets/[0-9a-f]{32}"), timeout=JOB_MS)
    expect(page.get_by_label("Verdict")).to_be_visible()


def test_from_an_empty_service_to_an_activated_set_and_back(
    browser: Browser, empty: Service, telemetry: list[Path], tle: str
) -> None:
    context = browser.new_context(viewport={"width": 1366, "height": 768})
    window = watched(context, empty)
    page = window.page
    sign_in(page, empty)
    expect(page.get_by_role("heading", name="First step: add a satellite")).to_be_visible()
    page.get_by_label("Id (lower case)").fill("dekart")
    page.get_by_label("Name").fill("DEKART")
    page.get_by_role("button", name="Add satellite").click()

    expect(page.get_by_role("heading", name="Next step: add its magnetometer")).to_be_visible()
    page.get_by_label("Id", exact=True).fill("mgm-1")
    page.get_by_label("Unit of its readings").select_option("nT")
    page.get_by_role("button", name="Add magnetometer").click()

    expect(page.get_by_role("heading", name="Upload telemetry")).to_be_visible()
    page.get_by_label("TLE or 3LE").fill(tle)
    page.get_by_role("button", name="Add orbit").click()
    expect(page.get_by_role("region", name="Orbits").locator("tbody tr")).to_have_count(2)

    upload(page, telemetry[0])
    page.get_by_role("link", name="Calibrate").click()
    calibrate(page)
    first = page.url
    page.get_by_role("button", name="Activate …").click()
    expect(page.get_by_role("dialog")).to_contain_text("None is in force now")
    page.get_by_role("dialog").get_by_role("button", name="Activate").click()
    expect(page.locator(".badge.status-active")).to_be_visible()

    page.get_by_role("link", name="dekart").click()
    upload(page, telemetry[1])
    page.get_by_role("link", name="Calibrate").click()
    calibrate(page)
    second = page.url
    page.get_by_role("button", name="Activate …").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.locator("tbody tr")).to_have_count(9)
    dialog.get_by_role("button", name="Keep as it is").click()
    expect(page.locator(".badge.status-candidate")).to_be_visible()
    page.get_by_role("button", name="Activate …").click()
    page.get_by_role("dialog").get_by_role("button", name="Activate").click()
    expect(page.locator(".badge.status-active")).to_be_visible()

    page.get_by_role("button", name="Roll back …").click()
    expect(page.get_by_role("dialog")).to_contain_text(f"Set {first[-8:]} comes back into force")
    page.get_by_role("dialog").get_by_role("button", name="Roll back").click()
    expect(page.locator(".badge.status-retired")).to_be_visible()
    page.goto(first)
    expect(page.locator(".badge.status-active")).to_be_visible()

    page.get_by_role("heading", name="Compare").scroll_into_view_if_needed()
    page.get_by_label("With").select_option(second[-32:])
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_role("heading", name="Compare parameter sets")).to_be_visible()
    expect(page.get_by_role("region", name="Differences").locator("tbody tr")).to_have_count(9)

    page.goto(f"{empty.url}/")
    row = page.get_by_role("region", name="Satellites").locator("tbody tr")
    expect(row).to_contain_text("accept")
    expect(row.locator("td").nth(6)).to_contain_text(" nT")
    context.close()
    window.check()


def test_a_file_dropped_on_the_page_is_uploaded(window: Watched, satellite: str, telemetry: list[Path]) -> None:
    page = window.open(f"/satellites/{satellite}")
    content = telemetry[0].read_text()
    transfer = page.evaluate_handle(
        """(text) => { const data = new DataTransfer();
           data.items.add(new File([text], "dropped.csv", { type: "text/csv" })); return data; }""",
        content,
    )
    page.locator(".drop").dispatch_event("drop", {"dataTransfer": transfer})
    expect(page.get_by_text("dropped.csv: session")).to_be_visible(timeout=JOB_MS)


def test_the_faults_of_a_file_stand_at_their_rows(window: Watched, satellite: str, tmp_path: Path) -> None:
    faulty = tmp_path / "faulty.csv"
    rows = [f"2022-02-19T22:{minute:02d}:00Z,20000,1000,-9000" for minute in range(40)]
    rows[11] = "2022-02-19T22:11:00Z,20000,abc,-9000"
    rows[29] = "yesterday,20000,1000,-9000"
    faulty.write_text("\n".join(["time,bx,by,bz", *rows]) + "\n")
    page = window.open(f"/satellites/{satellite}")
    page.get_by_label("Drop telemetry here").set_input_files(faulty)
    faults = page.get_by_role("alert").locator("tbody tr")
    expect(faults).to_have_count(2, timeout=JOB_MS)
    expect(faults.nth(0)).to_contain_text("line 13, column by")
    expect(faults.nth(1)).to_contain_text("line 31, column time")
    page.get_by_role("button", name="Clear faulty.csv").click()
    expect(faults).to_have_count(0)
    window.errors.clear()  # Chromium itself reports every answer of 422 in the console


def test_a_failed_job_tells_why_and_can_be_tried_again(window: Watched, satellite: str, telemetry: list[Path]) -> None:
    """By its session: jobs of others, such as those that judge a session as it arrives, come and go meanwhile."""
    with window.service.client() as service:
        short = "\n".join(telemetry[0].read_text().splitlines()[:40]) + "\n"
        sent = service.post(
            f"/satellites/{satellite}/sessions?magnetometer=mgm-1", content=short, headers={"Content-Type": "text/csv"}
        )
        session = sent.json()["id"]
        service.post("/jobs", json={"kind": "calibration", "session_ids": [session]}).raise_for_status()
    page = window.open("/jobs")
    own = page.locator("tbody tr", has_text=session[-8:]).filter(has_text="calibration")
    failed = own.filter(has=page.locator(".state-failed"))
    expect(failed).to_contain_text("not_observable", timeout=JOB_MS)
    failed.get_by_text("not_observable").click()
    expect(failed).to_contain_text("observability index")
    failed.get_by_role("button", name="Retry").click()
    expect(own).to_have_count(2, timeout=JOB_MS)
    expect(page.locator("details[open]")).to_have_count(1)  # what was being read stays open


def test_a_key_is_made_shown_once_and_revoked(window: Watched) -> None:
    page = window.open("/keys")
    page.get_by_label("Name").fill("ground station north")
    page.get_by_role("button", name="Create key").click()
    secret = page.locator(".secret")
    expect(secret).to_contain_text("mgc_")
    key = secret.inner_text()
    row = page.get_by_role("region", name="Keys").locator("tr", has_text="ground station north").first
    row.get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
    expect(row).to_contain_text("revoked")
    page.reload()
    expect(page.get_by_role("region", name="Keys")).to_be_visible()
    assert key not in page.content()


def test_signing_out_ends_the_login_and_a_wrong_key_is_told(window: Watched) -> None:
    page = window.page
    page.get_by_role("button", name="Sign out").click()
    page.get_by_label("Key").fill("mgc_wrong")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("not a valid key")
    window.errors.clear()  # Chromium itself reports the answer of 403 in the console

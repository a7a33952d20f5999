"""What an operator sets right on the pages: how a file is read, a magnetometer's policy, a whole history anew."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.browser.conftest import Service, Watched
from tests.browser.mission import SATELLITE, Mission, fly

pytestmark = pytest.mark.browser
JOB_MS = 60_000
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21aa", "wcag22aa", "best-practice"]}


@pytest.fixture(scope="module")
def mission(service: Service) -> Iterator[Mission]:
    with service.client() as client:
        yield fly(client)


def check_look(page: Page) -> None:
    """The page is accessible in both themes, and no wider than a phone's screen where it is one."""
    for _ in range(2):
        found = Axe().run(page, {"exclude": [[".plot svg"]]}, RULES).response["violations"]
        assert {one["id"]: [node["html"][:200] for node in one["nodes"]] for one in found} == {}
        page.locator("#theme").click()
    page.set_viewport_size({"width": 390, "height": 844})
    width = page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    page.set_viewport_size({"width": 1366, "height": 768})
    assert width[0] <= width[1], "the page scrolls sideways on a phone"


def foreign(file: Path, source: Path) -> Path:
    """The telemetry as another station writes it: its own names, uT, times without a zone."""
    lines = ["Zeit;Mag X [uT];Mag Y [uT];Mag Z [uT];Temp"]
    for row in source.read_text().splitlines()[1:]:
        time, *reading = row.split(",")[:4]
        values = ";".join(f"{float(value) / 1e3:.6f}" for value in reading)
        lines.append(f"{time[:19].replace('T', ' ')};{values};20.5")
    file.write_text("\n".join(lines) + "\n")
    return file


def test_a_file_of_other_columns_is_read_as_the_operator_says(
    window: Watched, telemetry: list[Path], tmp_path: Path
) -> None:
    """Refused, looked at, its columns, unit and times chosen, kept on the magnetometer, sent; its like then goes in."""
    with window.service.client() as client:
        client.post("/satellites", json={"id": "odd"}).raise_for_status()
        client.post("/satellites/odd/magnetometers", json={"id": "mgm-1", "unit": "nT"}).raise_for_status()
    file = foreign(tmp_path / "odd.csv", telemetry[0])
    page = window.open("/satellites/odd")
    page.get_by_label("Drop telemetry here").set_input_files(file)
    page.get_by_role("button", name="Choose its columns").click(timeout=JOB_MS)
    panel = page.locator(".panel")
    expect(panel.get_by_role("region", name="First rows as they stand").locator("tbody tr")).to_have_count(5)
    expect(panel.get_by_label("bx", exact=True)).to_have_value("Mag X [uT]")
    panel.get_by_label("Time", exact=True).select_option("Zeit")
    panel.get_by_label("Form of the times").select_option("utc")
    expect(panel.get_by_text("they look like uT")).to_be_visible()
    panel.get_by_label("Unit of the readings").select_option("uT")
    expect(panel.get_by_role("region", name="First rows as read").locator("tbody tr")).to_have_count(5)
    check_look(page)
    panel.get_by_role("button", name="Keep for mgm-1 and send").click()
    expect(page.get_by_text("odd.csv: session")).to_be_visible(timeout=JOB_MS)
    expect(page.get_by_role("region", name="Sessions", exact=True).locator("tbody tr")).to_have_count(1)

    page.get_by_label("Look at the first rows before sending").check()
    second = foreign(tmp_path / "next.csv", telemetry[1])
    page.get_by_label("Drop telemetry here").set_input_files(second)
    expect(panel.get_by_text("samples", exact=False).first).to_be_visible()
    panel.get_by_role("button", name="Keep for mgm-1 and send").click()
    expect(page.get_by_text("next.csv: session")).to_be_visible(timeout=JOB_MS)
    window.errors.clear()  # Chromium itself reports every answer of 422 in the console


def test_a_policy_and_a_column_map_are_set_on_the_magnetometers_page(window: Watched, mission: Mission) -> None:
    page = window.open(mission.addresses["magnetometer"])
    policy = page.locator("section", has=page.get_by_role("heading", name="Policy"))
    expect(policy).to_contain_text("Each session is calibrated when it arrives, with robust tukey")
    policy.get_by_label("Outliers").select_option("huber")
    policy.get_by_label("Regressors").fill("temperature, torque_*")
    policy.get_by_role("button", name="Change the policy").click()
    expect(policy).to_contain_text("with regressors temperature, torque_*, robust huber")

    page.get_by_text("Change it", exact=True).click()
    page.get_by_label("Column of bx").fill("mag_x")
    page.get_by_role("button", name="Add a column").click()
    page.get_by_label("Name in magcal").fill("temperature")
    page.get_by_label("Column of a further column").fill("T_sensor")
    page.get_by_label("base x = sensor").select_option("-y")
    page.get_by_label("base y = sensor").select_option("x")
    page.get_by_label("Numbers that stand for no reading").fill("-9999, 32767")
    check_look(page)
    page.get_by_role("button", name="Change how it is read").click()
    expect(page.get_by_role("cell", name="bx = mag_x, temperature = T_sensor")).to_be_visible()
    with window.service.client() as client:
        kept = client.get(f"/satellites/{SATELLITE}/magnetometers/mgm-1").json()
    assert (kept["axis_map"], kept["fill_values"]) == (["-y", "x", "z"], [-9999, 32767])
    assert kept["policy"]["regressors"] == ["temperature", "torque_*"] and kept["policy"]["method"] == "scalar"

    page.get_by_role("button", name="Remove the policy").click()
    page.get_by_role("dialog").get_by_role("button", name="Remove").click()
    expect(policy).to_contain_text("nothing happens by itself")


def test_two_magnetometers_stand_beside_each_other_and_are_compared_in_flight(
    window: Watched, mission: Mission
) -> None:
    page = window.open(mission.addresses["magnetometers"])
    rows = page.get_by_role("region", name="Magnetometers beside each other").locator("tbody tr")
    expect(rows.filter(has_text="b1, nT").locator("td")).to_have_count(2)
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_text("pairs of readings")).to_be_visible(timeout=JOB_MS)
    expect(page.get_by_role("region", name="Differences by axis").locator("tbody tr")).to_have_count(3)
    check_look(page)


def test_a_history_is_reprocessed_and_its_sets_held_beside_those_in_force(window: Watched, mission: Mission) -> None:
    page = window.open("/reprocessings")
    page.get_by_label("Satellite", exact=True).select_option(SATELLITE)
    page.get_by_label("Magnetometer").fill("mgm-1")
    page.get_by_label("Noise model").select_option("white")
    check_look(page)
    page.get_by_role("button", name="Reprocess …").click()
    expect(page.get_by_role("dialog")).to_contain_text("2 sessions will be calibrated anew, with noise model white")
    page.get_by_role("dialog").get_by_role("button", name="Reprocess").click()
    expect(page.get_by_text("2 succeeded")).to_be_visible(timeout=JOB_MS)
    page.get_by_role("button", name="Compare with the sets in force").click()
    expect(page.get_by_role("status").filter(has_text="Of 2:")).to_contain_text("from the set in force")
    expect(page.get_by_role("region", name="Its calibrations").locator("tbody .badge.refuse")).to_have_count(1)
    check_look(page)


def test_a_page_lives_from_the_stream_of_events_and_says_where_it_is_lost(
    window: Watched, telemetry: list[Path]
) -> None:
    """With the stream, at once: by itself the page asks only once a minute. Without it, every ten seconds."""
    page = window.open("/")
    expect(page.locator("#live")).to_have_text("● live")
    row = page.get_by_role("region", name="Satellites").locator("tbody tr", has_text="lively")
    with window.service.client() as client:
        client.post("/satellites", json={"id": "lively"}).raise_for_status()
        client.post("/satellites/lively/magnetometers", json={"id": "mgm-1", "unit": "nT"}).raise_for_status()
        content, headers = telemetry[0].read_bytes(), {"Content-Type": "text/csv"}
        path = "/satellites/lively/sessions?magnetometer=mgm-1"
        client.post(path, content=content, headers=headers).raise_for_status()
        expect(row).to_be_visible(timeout=20_000)

        page.route("**/api/v1/events*", lambda route: route.abort())
        page.reload()
        expect(page.locator("#live")).to_have_text("◆ not live: asks every 10 s")
        client.patch("/satellites/lively", json={"name": "RENAMED"}).raise_for_status()
        expect(row.filter(has_text="RENAMED")).to_be_visible()
    window.errors.clear()  # Chromium itself reports that the stream is refused in the console

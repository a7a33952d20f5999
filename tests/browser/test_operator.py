"""What an operator sets right on the pages: how a file is read, a magnetometer's policy, a whole history anew."""

from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.browser.conftest import Watched

pytestmark = pytest.mark.browser
JOB_MS = 60_000
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21aa", "wcag22aa", "best-practice"]}


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

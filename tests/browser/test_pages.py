"""What pages do: tables, figures, reports, refits; the whole of each page on every screen is in `test_screens`."""

import csv
import io
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Route, expect

from tests.browser.conftest import Service, Watched, wait_until_quiet, watched

pytestmark = pytest.mark.browser
PICTURES = Path(__file__).resolve().parents[2] / "artefacts" / "pages"
PAGES = ["overview", "satellite", "session", "parameter-set", "compare", "jobs", "keys"]
DRAWN_MS = 60_000
AT_A_GLANCE = 9


@pytest.fixture(scope="module")
def addresses(service: Service, satellite: str) -> dict[str, str]:
    with service.client() as client:
        sets = client.get(f"/parameter-sets?satellite={satellite}").json()["items"]
    return {
        "overview": "/",
        "satellite": f"/satellites/{satellite}",
        "session": f"/sessions/{sets[0]['session_ids'][0]}",
        "parameter-set": f"/parameter-sets/{sets[0]['id']}",
        "compare": f"/compare?first={sets[0]['id']}&second={sets[1]['id']}",
        "jobs": "/jobs",
        "keys": "/keys",
    }


def test_the_sign_in_page_is_accessible(browser: Browser, service: Service) -> None:
    context = browser.new_context()
    window = watched(context, service)
    page = window.open("/")
    expect(page.get_by_label("Key")).to_be_focused()
    assert Axe().run(page).violations_count == 0
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / "sign-in.png")
    context.close()
    window.check()


def test_the_skip_link_leads_past_the_navigation(window: Watched) -> None:
    page = window.open("/")
    page.locator("body").press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    page.keyboard.press("Enter")
    assert page.evaluate("() => document.activeElement.id") == "main"


def test_a_table_sorts_filters_and_saves_what_it_shows(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["satellite"])
    region = page.get_by_role("region", name="Parameter sets")
    expect(region.locator("tbody tr").first).to_be_visible()
    heading = region.get_by_role("columnheader", name="after")
    heading.get_by_role("button").click()
    expect(heading).to_have_attribute("aria-sort", "descending")
    values = [float(text.replace(",", "")) for text in region.locator("tbody tr td:nth-child(8)").all_inner_texts()]
    assert values == sorted(values, reverse=True)
    with window.service.client() as client:
        done = client.get("/audit?limit=500&q=orbit.create").json()["items"]
    page = window.open("/keys")
    audit = page.get_by_role("region", name="Audit trail")
    page.get_by_label("Filter Audit trail").fill("ORBIT.create")
    expect(audit.locator("tbody tr")).to_have_count(len(done))
    with page.expect_download() as download:
        page.get_by_role("button", name="Save Audit trail as CSV").click()
    saved = list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text())))
    assert [row["action"] for row in saved] == ["orbit.create"] * len(done) != []


def test_a_cell_that_a_spreadsheet_would_run_is_harmless_in_the_file(window: Watched, service: Service) -> None:
    names = ["=1+1", "@sum", "+cmd|'x'!A1", "-2+3"]
    with service.client() as client:
        for name in names:
            client.post("/keys", json={"scopes": ["read"], "name": name}).raise_for_status()
    page = window.open("/keys")
    region = page.get_by_role("region", name="Keys", exact=True)
    expect(region.get_by_text(names[0], exact=True)).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save Keys as CSV").click()
    saved = list(csv.DictReader(io.StringIO(Path(download.value.path()).read_text())))
    assert {f"'{name}" for name in names} <= {row["name"] for row in saved}


@pytest.mark.parametrize("name", PAGES)
def test_every_table_sorts_and_exports_and_filters_where_it_is_long(
    name: str, window: Watched, addresses: dict[str, str]
) -> None:
    """Nine rows are seen at a glance. Tables of facts, a name and a value a row, are no tables of data."""
    page = window.open(addresses[name])
    wait_until_quiet(page)
    expect(page.locator(".table").first).to_be_visible()
    bare = page.locator("table:not(.facts)").evaluate_all("(all) => all.filter((one) => !one.closest('.table')).length")
    assert bare == 0
    for found in page.locator(".table").all():
        rows = found.locator("tbody tr").count()
        expect(found.locator("input[type=search]")).to_be_visible(visible=rows > AT_A_GLANCE)
        expect(found.get_by_role("button", name="as CSV")).to_be_visible()
        heading = found.get_by_role("columnheader").first
        heading.get_by_role("button").click()
        assert heading.get_attribute("aria-sort") in {"ascending", "descending"}


def test_a_table_that_grows_beyond_nine_rows_has_a_filter(window: Watched) -> None:
    with window.service.client() as client:
        client.post("/satellites", json={"id": "growing"}).raise_for_status()
        client.post("/satellites/growing/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()

        def send(number: int) -> None:
            rows = f"2026-01-{number:02d}T00:00:00Z,20000,1,2\n2026-01-{number:02d}T00:00:01Z,20001,1,2\n"
            path = "/satellites/growing/sessions?magnetometer=mgm"
            sent = client.post(path, content="time,bx,by,bz\n" + rows, headers={"Content-Type": "text/csv"})
            sent.raise_for_status()

        for number in range(1, AT_A_GLANCE + 1):
            send(number)
        page = window.open("/satellites/growing")
        rows = page.get_by_role("region", name="Sessions", exact=True).locator("tbody tr")
        expect(rows).to_have_count(AT_A_GLANCE)
        filter_box = page.get_by_label("Filter Sessions")
        expect(filter_box).to_be_hidden()
        send(AT_A_GLANCE + 1)
        expect(rows).to_have_count(AT_A_GLANCE + 1)
        expect(filter_box).to_be_visible()
        filter_box.fill("2026-01-10")
        expect(rows).to_have_count(1)


def test_pointing_impact_is_simulated_where_it_is_asked_for(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["parameter-set"])
    page.get_by_role("button", name="Simulate").click()
    rows = page.get_by_role("region", name="Pointing impact").locator("tbody tr")
    expect(rows).to_have_count(4, timeout=DRAWN_MS)
    raw, calibrated = (float(rows.nth(i).locator("td").first.inner_text()) for i in (1, 2))
    assert calibrated < raw


def test_a_refit_shows_what_a_span_left_out_would_change(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["parameter-set"])
    region = page.locator("section", has=page.get_by_role("heading", name="What if"))
    region.get_by_label("Leave out from, UTC").fill("2022-02-19 23:00:00")
    region.get_by_label("until, UTC", exact=True).fill("2022-02-19 23:20:00")
    region.get_by_label("Bootstrap replicates").fill("50")
    region.get_by_role("button", name="Refit", exact=True).click()
    expect(region.locator("tbody tr")).to_have_count(9, timeout=DRAWN_MS)
    expect(region).to_contain_text("% left out")
    for heading in ("standard error", "bootstrap error"):
        expect(region.get_by_role("columnheader", name=heading, exact=True)).to_be_visible()
    region.get_by_label("Regressors").fill("nobody")
    region.get_by_role("button", name="Refit", exact=True).click()
    expect(region.get_by_role("alert")).to_contain_text("regressors")
    window.errors.clear()  # Chromium itself reports the answer of 422 in the console


def test_an_on_board_table_is_saved_as_a_c_header(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["parameter-set"])
    page.get_by_label("Convention").select_option("on-board")
    page.get_by_label("Format").select_option("c")
    with page.expect_download() as download:
        page.get_by_role("button", name="Save", exact=True).click()
    assert download.value.suggested_filename.endswith("-on-board.h")
    assert "MAGCAL_ROTATION[3][3]" in Path(download.value.path()).read_text()


def test_dark_and_light_are_kept_and_the_figures_follow(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["parameter-set"])
    plot = page.locator(".plot").first
    expect(plot).to_have_attribute("data-drawn", "light", timeout=20_000)
    page.get_by_role("button", name="Dark").click()
    expect(plot).to_have_attribute("data-drawn", "dark", timeout=20_000)
    page.reload()
    expect(page.locator("html")).to_have_attribute("data-theme", "dark")


def test_numbers_come_before_the_plot_library(window: Watched, addresses: dict[str, str]) -> None:
    """The library is not let through before the numbers are there."""
    page = window.page
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route("**/assets/plotly-*", hold)
    page.goto(window.service.url + addresses["parameter-set"], wait_until="commit")
    expect(page.locator(".tiles dd").first).to_contain_text("nT")
    assert page.evaluate("() => typeof window.Plotly") == "undefined"
    for route in held:
        route.continue_()


def test_the_report_opens_from_its_page_and_draws_all_figures(window: Watched, addresses: dict[str, str]) -> None:
    page = window.open(addresses["parameter-set"])
    page.get_by_role("link", name="Report").click()
    expect(page.get_by_role("heading", name="Results and uncertainty")).to_be_visible()
    expect(page.locator(".plate:has(.main-svg)")).to_have_count(7, timeout=30_000)
    assert page.locator(".plate").count() == 7
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / "report.png", full_page=True)

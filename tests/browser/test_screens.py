"""Every page on every screen: a laptop, a wide screen, a phone, a laptop at 200 %; in both themes; printed."""

import time
from collections.abc import Iterator

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page

from tests.browser.conftest import Service, Watched, check_keyboard, draw_figures, serve, sign_in, watched
from tests.browser.mission import Mission, fly

pytestmark = pytest.mark.browser
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21aa", "wcag22aa", "best-practice"]}
PAGES = (
    "overview", "wall", "satellite", "magnetometer", "magnetometers", "session", "parameter-set", "compare", "jobs",
    "reprocessings", "reprocessing", "reasons", "keys", "unknown",
)  # fmt: skip
RESIZE_S = 20.0
SCREENS = {"wide": (2560, 1440), "laptop": (1366, 768), "laptop at 200 %": (683, 384), "phone": (390, 844)}
"""In the page's own pixels: at 200 % a laptop has half of its own."""
CUT = """() => {
  const width = document.documentElement.clientWidth;
  const scrolls = (node) => node.closest(".scroll, .top nav, .plot, .hidden-word, .skip");
  const says = (node) => `${node.tagName.toLowerCase()}.${node.className}: ${node.textContent.trim().slice(0, 60)}`;
  const found = [];
  for (const node of document.querySelectorAll("body *")) {
    if (!node.checkVisibility() || scrolls(node)) continue;
    const box = node.getBoundingClientRect();
    if (!box.width || box.right <= 0) continue;
    const style = getComputedStyle(node);
    const hides = style.overflowX === "hidden" || style.overflowX === "clip" || node.matches("button, select, .badge");
    if (box.right > width + 1) found.push(`beyond the edge: ${says(node)}`);
    else if (hides && node.scrollWidth > node.clientWidth + 1) found.push(`cut: ${says(node)}`);
  }
  return [document.documentElement.scrollWidth - width, [...new Set(found)]];
}"""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Mission]]:
    for service in serve(tmp_path_factory.mktemp("flown")):
        with service.client() as client:
            yield service, fly(client)


@pytest.fixture(scope="module", params=["light", "dark"])
def screen(request: pytest.FixtureRequest, browser: Browser, flown: tuple[Service, Mission]) -> Iterator[Watched]:
    service, _ = flown
    context = browser.new_context(device_scale_factor=2, color_scheme=request.param)
    found = watched(context, service)
    sign_in(found.page, service)
    yield found
    context.close()


def fitted(page: Page) -> tuple[int, list[str]]:
    """How far the page is wider than the screen, and what is cut: once its figures have taken the width."""
    until = time.monotonic() + RESIZE_S
    while True:
        beyond, cut = page.evaluate(CUT)
        if (beyond, cut) == (0, []) or time.monotonic() > until:
            return beyond, cut
        page.wait_for_timeout(100)


@pytest.mark.parametrize("name", PAGES)
def test_a_page_fits_every_screen_is_accessible_by_keyboard_too_and_prints(
    name: str, screen: Watched, flown: tuple[Service, Mission]
) -> None:
    page = screen.page
    page.set_viewport_size({"width": 1366, "height": 768})
    screen.open(flown[1].addresses[name])
    draw_figures(page)
    is_dark = page.evaluate("() => document.documentElement.dataset.theme === 'dark'")
    for where, (width, height) in SCREENS.items():
        page.set_viewport_size({"width": width, "height": height})
        assert fitted(page) == (0, []), where
        if where == "phone":
            continue
        # The colours inside figures are checked where the figures are.
        found = Axe().run(page, {"exclude": [[".plot svg"]]}, RULES).response["violations"]
        assert {one["id"]: [node["html"][:200] for node in one["nodes"]] for one in found} == {}, where
    page.set_viewport_size({"width": 1366, "height": 768})
    if not is_dark:
        check_keyboard(page)
    assert printed(page) == (["rgb(255, 255, 255)", "rgb(0, 0, 0)", [], []], True)
    if name == "unknown":
        screen.errors.clear()  # Chromium itself reports the answer of 404 in the console
    screen.check()


def printed(page: Page) -> tuple[list[object], bool]:
    """Return the colours of paper and title, what is dark or a button on it, and whether dark figures are turned."""
    page.emulate_media(media="print")
    colours = page.evaluate(
        """() => { const of = (node) => getComputedStyle(node);
           const dark = [...document.querySelectorAll("main *, main")].filter((node) => node.checkVisibility()
             && !node.closest(".plot, svg, progress")).filter((node) => { const [r, g, b, a = 1] =
             (of(node).backgroundColor.match(/[\\d.]+/g) ?? []).map(Number);
             return a > 0 && Math.min(r, g, b) < 200; });
           return [of(document.body).backgroundColor, of(document.querySelector("h1")).color,
             dark.map((node) => node.outerHTML.slice(0, 120)),
             [...document.querySelectorAll("main button, .top")].filter((node) => node.checkVisibility()
               && !node.closest("th, .plot")).map((node) => node.outerHTML.slice(0, 120))]; }"""
    )
    turned = page.evaluate(
        """() => document.documentElement.dataset.theme !== "dark" || [...document.querySelectorAll(".plot")].every(
           (node) => getComputedStyle(node).filter.startsWith("invert(1)"))"""
    )
    page.emulate_media(media="screen")
    return colours, bool(turned)


@pytest.mark.parametrize(("width", "wanted"), [(390, [0, 1]), (1366, [0.35, 0.63])])
def test_panels_of_a_history_stand_below_each_other_on_a_phone(
    width: int, wanted: list[float], browser: Browser, flown: tuple[Service, Mission]
) -> None:
    """Three beside each other write their dates over one another there."""
    service, mission = flown
    context = browser.new_context(viewport={"width": width, "height": 800})
    found = watched(context, service)
    sign_in(found.page, service)
    page = found.open(mission.addresses["satellite"])
    page.get_by_role("group", name="Bias, scale and angles over time").scroll_into_view_if_needed()
    page.wait_for_function("() => document.querySelector('.plot[data-drawn]') !== null")
    domain = page.evaluate("() => document.querySelector('.plot[data-drawn]').layout.xaxis2.domain")
    assert domain == pytest.approx(wanted)
    context.close()
    found.check()

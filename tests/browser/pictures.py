"""Pictures of every page from a mission of its own, for whoever looks: `make pictures`.

Light and dark, on a laptop, a wide screen, a phone, and a laptop at 200 %: PAGE-THEME-LOOK.png in the folder that is
named; and each page as the dark one prints, PAGE-print.png.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser.conftest import BROWSERS, FLAGS, Service, serve, sign_in
from tests.browser.mission import fly

LOOKS = {"1366": (1366, 768, 1), "2560": (2560, 1440, 1), "390": (390, 844, 2), "200-percent": (683, 384, 2)}
"""Name -> width and height in the page's own pixels, and pixels of the screen in one of them."""
THEMES = ("light", "dark")
WAIT_MS = 60_000


def settle(page: Page) -> None:
    """Wait until a page has its numbers, each figure is drawn, and what is loaded when one comes near is there."""
    page.locator("h1").first.wait_for()
    next_one = """() => { const node = document.querySelector(".plot[aria-busy]")
          ?? [...document.querySelectorAll("main p")].find((one) => one.textContent === "Loading …");
        node?.scrollIntoView(); return !node; }"""
    page.wait_for_timeout(700)
    page.wait_for_function(next_one, timeout=WAIT_MS, polling=200)
    page.evaluate("() => scrollTo(0, 0)")


def take(browser: Browser, service: Service, addresses: dict[str, str], folder: Path) -> None:
    """Take every page in every look, and the sign-in page."""
    for theme in THEMES:
        for look, (width, height, scale) in LOOKS.items():
            screen = {"width": width, "height": height}
            context = browser.new_context(viewport=screen, device_scale_factor=scale, color_scheme=theme)
            page = context.new_page()
            page.goto(service.url + "/")
            page.screenshot(path=folder / f"sign-in-{theme}-{look}.png")
            sign_in(page, service)
            for name, address in addresses.items():
                page.goto(service.url + address)
                settle(page)
                page.screenshot(path=folder / f"{name}-{theme}-{look}.png", full_page=True)
                if (theme, look) == ("dark", "1366"):
                    page.emulate_media(media="print")
                    page.screenshot(path=folder / f"{name}-print.png", full_page=True)
                    page.emulate_media(media="screen")
            context.close()


def main(folder: Path) -> int:
    """Write the pictures into ``folder``; return the exit status."""
    engine = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if engine is None:
        sys.stderr.write("no Chromium is installed; `make system` installs one\n")
        return 1
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="magcal-pictures-") as place, sync_playwright() as playwright:
        running = serve(Path(place) / "service")
        try:
            service = next(running)
            with service.client() as client:
                mission = fly(client)
            browser = playwright.chromium.launch(executable_path=engine, args=FLAGS)
            take(browser, service, mission.addresses, folder)
            browser.close()
        finally:
            running.close()
    sys.stdout.write(f"{len(list(folder.glob('*.png')))} pictures are in {folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "artefacts/pages-of-a-mission")))

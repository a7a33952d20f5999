"""A real service in a process of its own, and a real Chromium that looks at it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Request, expect, sync_playwright

MAGCAL = Path(sys.executable).with_name("magcal")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
START_S = 60.0
DRAWN_S = 60.0
MOST_STOPS = 1000
"""Of the Tab key on any page, its figures' buttons with it."""
COUNT_REQUESTS = """
  window.asked = { open: 0, quietSince: performance.now() };
  const plain = window.fetch;
  window.fetch = (...given) => {
    asked.open += 1;
    return plain(...given).finally(() => { asked.open -= 1; asked.quietSince = performance.now(); });
  };
"""
"""What a page asks the service for is counted: its stream of events never ends, so that no page is ever without one."""
QUIET = "() => asked.open === 0 && performance.now() - asked.quietSince > 500"
expect.set_options(timeout=30_000)


@dataclass(frozen=True)
class Service:
    """Where the service under test answers, and its first key."""

    url: str
    key: str

    def client(self) -> httpx2.Client:
        headers = {"Authorization": f"Bearer {self.key}"}
        return httpx2.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=60.0)


@dataclass
class Watched:
    """A page, and what it did that it should not: requests elsewhere, errors in the console."""

    page: Page
    service: Service
    outside: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def open(self, path: str) -> Page:
        self.page.goto(self.service.url + path)
        self.page.locator("h1").first.wait_for()
        return self.page

    def check(self) -> None:
        assert self.outside == []
        assert self.errors == []


def serve(folder: Path) -> Iterator[Service]:
    """Run `magcal serve` on a free port over an empty data folder until the generator is closed."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"MAGCAL_DATA_DIR": str(folder / "data"), "MAGCAL_LOG_FORMAT": "json"}
    with (folder / "out").open("w") as out, (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [MAGCAL, "serve", "--port", "0", "--workers", "1"], stdout=out, stderr=log, env=environment, cwd=folder
        )
    try:
        yield _ready(process, folder)
    finally:
        process.terminate()
        process.wait(timeout=60)


def _ready(process: subprocess.Popen[bytes], folder: Path) -> Service:
    until = time.monotonic() + START_S
    while time.monotonic() < until and process.poll() is None:
        key = next(
            (line[11:] for line in (folder / "out").read_text().splitlines() if line.startswith("admin key: ")), None
        )
        lines = [line for line in (folder / "log").read_text().splitlines() if '"listening"' in line]
        if key and lines:
            return Service(json.loads(lines[0])["url"], key.strip())
        time.sleep(0.1)
    pytest.fail(f"the service did not start: {(folder / 'log').read_text()[-2000:]}")


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    yield from serve(tmp_path_factory.mktemp("service"))


@pytest.fixture(scope="session")
def tle(data_dir: Path) -> str:
    return (data_dir / "dekart.tle.txt").read_text()


@pytest.fixture(scope="session")
def telemetry(tmp_path_factory: pytest.TempPathFactory, data_dir: Path) -> list[Path]:
    """Two sessions of DEKART, as the satellite would send them."""
    folder = tmp_path_factory.mktemp("telemetry")
    starts = ["2022-02-19T22:37:44Z", "2022-04-07T21:42:49Z"]
    files = []
    for seed, start in enumerate(starts):
        target = folder / f"session-{seed + 1}.csv"
        options = ["--start", start, "--duration", "6000", "--step", "10", "--seed", str(seed), "--noise", "100"]
        sensor = ["--bias", "2928,-1191,-1876", "--scale", "1.033,1.007,1.033", "--eps", "-4.53,-1.07,7.92"]
        command = [MAGCAL, "simulate", "--tle", data_dir / "dekart.tle.txt", *options, *sensor, "--rate", "0.76"]
        subprocess.run([*command, "-o", target], check=True, capture_output=True, timeout=120)
        files.append(target)
    return files


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    engine = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    assert engine is not None, "no Chromium is installed; `make system` installs one"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=engine, args=FLAGS)
        yield browser
        browser.close()


def wait_until_quiet(page: Page) -> None:
    """Wait until a page that `watched` has opened has asked the service for nothing for half a second."""
    page.wait_for_function(QUIET, polling=100)


def draw_figures(page: Page) -> None:
    """Scroll through the page until every figure is drawn."""
    page.locator("h1").first.wait_for()
    wait_until_quiet(page)
    next_one = """() => { const node = document.querySelector(".plot[aria-busy]");
        node?.scrollIntoView(); return node === null; }"""
    until = time.monotonic() + DRAWN_S
    while not page.evaluate(next_one):
        assert time.monotonic() < until, "a figure is not drawn"
        page.wait_for_timeout(100)
    assert page.locator('.plot[data-drawn="failed"]').count() == 0
    page.evaluate("() => scrollTo(0, 0)")


def check_keyboard(page: Page) -> None:
    """Check that the Tab key comes to all that can be clicked in a page, and that one sees where it is."""
    wanted = page.evaluate(
        """() => [...document.querySelectorAll("main :is(a[href], button, input, select, textarea, summary)")]
          .filter((node) => node.checkVisibility() && !node.disabled && !node.closest(".plot"))
          .map((node, i) => { node.dataset.reach = i; return String(i); })"""
    )
    page.evaluate("() => document.querySelector('.skip').focus()")
    reached = set()
    for _ in range(MOST_STOPS):
        page.keyboard.press("Tab")
        mark, is_shown, is_round = page.evaluate(
            """() => { const node = document.activeElement;
               const isShown = node.matches(":focus-visible") || node.type === "datetime-local";
               return [node.dataset.reach ?? null, isShown, node.matches(".skip, body")]; }"""
        )
        if is_round:
            break
        if mark is not None:
            reached.add(mark)
            assert is_shown, page.evaluate("() => document.activeElement.outerHTML.slice(0, 200)")
    left = sorted(set(wanted) - reached, key=int)
    assert [
        page.locator(f'[data-reach="{one}"]').evaluate_all("(all) => all.map((one) => one.outerHTML)") for one in left
    ] == []


def watched(context: BrowserContext, service: Service) -> Watched:
    context.add_init_script(COUNT_REQUESTS)
    found = Watched(context.new_page(), service)

    def look(request: Request) -> None:
        if not request.url.startswith((service.url, "data:", "blob:")):
            found.outside.append(request.url)

    found.page.on("request", look)
    found.page.on("console", lambda said: found.errors.append(said.text) if said.type in {"error", "warning"} else None)
    found.page.on("pageerror", lambda error: found.errors.append(str(error)))
    return found


def sign_in(page: Page, service: Service) -> None:
    page.goto(service.url + "/")
    page.get_by_label("Key").fill(service.key)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("button", name="Sign out").wait_for()


@pytest.fixture
def window(browser: Browser, service: Service) -> Iterator[Watched]:
    """A signed-in window of a laptop's size; what it did amiss fails the test at its end."""
    context = browser.new_context(viewport={"width": 1366, "height": 768}, color_scheme="light")
    found = watched(context, service)
    sign_in(found.page, service)
    yield found
    context.close()
    found.check()


@pytest.fixture(scope="session")
def satellite(service: Service, telemetry: list[Path], tle: str) -> str:
    """A satellite with two calibrated sessions, three parameter sets of which one is in force."""
    with service.client() as client:
        client.post("/satellites", json={"id": "seen", "name": "SEEN"}).raise_for_status()
        client.post("/satellites/seen/magnetometers", json={"id": "mgm-1", "unit": "nT"}).raise_for_status()
        client.post("/satellites/seen/orbits", content=tle, headers={"Content-Type": "text/plain"}).raise_for_status()
        sessions = [_upload(client, file) for file in telemetry]
        made = [_calibrated(client, sessions[0], "scalar"), _calibrated(client, sessions[1], "scalar")]
        _calibrated(client, sessions[0], "scalar-hooke-jeeves")
        client.post(f"/parameter-sets/{made[0]}/activate", json={}).raise_for_status()
    return "seen"


def _upload(client: httpx2.Client, file: Path) -> str:
    headers = {"Content-Type": "text/csv"}
    sent = client.post("/satellites/seen/sessions?magnetometer=mgm-1", content=file.read_bytes(), headers=headers)
    return str(sent.raise_for_status().json()["id"])


def _calibrated(client: httpx2.Client, session_id: str, method: str) -> str:
    body = {"kind": "calibration", "session_ids": [session_id], "method": method}
    job = client.post("/jobs", json=body).raise_for_status().json()
    until = time.monotonic() + START_S
    while job["state"] in {"queued", "running"} and time.monotonic() < until:
        time.sleep(0.2)
        job = client.get(f"/jobs/{job['id']}").json()
    assert job["state"] == "succeeded", job
    return str(job["result"]["parameter_set_id"])

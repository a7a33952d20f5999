"""The dashboard in a real browser with a history of 1,000 parameter sets and a session of 100,000 samples.

First numbers are there when a cell or tile with a digit in it has been painted, told by the page itself from the
beginning of its navigation; the page before has come to rest by then. The note says when the page, which goes on with
its figures, also answered the program that drives the browser.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import httpx2
import numpy as np

from benchmarks.measure import Figure
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.simulation.dekart_mission import SESSIONS, tle_of, tle_text
from magcal_core.simulation.telemetry import simulate
from magcal_core.telemetry import write_samples

if TYPE_CHECKING:
    from playwright.sync_api import Page

ROOM: Final = "pages"
SAMPLES: Final = 100_000
SETS: Final = 1000
ROUNDS: Final = 3
NUMBERS_AIM_S: Final = 0.5
PLOTS_AIM_S: Final = 3.0
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome")
NUMBERS: Final = """
new MutationObserver((_changes, watch) => {
  const cells = [...document.querySelectorAll(".tiles dd, tbody td")];
  if (!cells.some((cell) => /\\d/.test(cell.textContent) && cell.checkVisibility())) return;
  watch.disconnect();
  requestAnimationFrame(() => setTimeout(() => { window.numbersMs = performance.now(); }));
}).observe(document, { subtree: true, childList: true, characterData: true });
"""
"""Run in every page before its own scripts."""
ASKED: Final = """
window.asked = { open: 0, since: performance.now() };
const plain = window.fetch;
window.fetch = (...given) => {
  asked.open += 1;
  return plain(...given).finally(() => { asked.open -= 1; asked.since = performance.now(); });
};
"""
"""Counts what a page asks the service for; its stream of events never ends, so that the network is never idle."""
QUIET: Final = "() => !window.asked || (asked.open === 0 && performance.now() - asked.since > 500)"
FLAGS: Final = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]


def figures() -> Iterator[Figure]:
    """Yield, for each page, the time to its first numbers and to the figures in its window."""
    engine = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if engine is None:
        return
    with tempfile.TemporaryDirectory(prefix="magcal-bench-") as folder:
        root = Path(folder)
        with service_over(root) as (url, key):
            pages = _fill(url, key)
        _multiply(root / "data" / "magcal.db")
        with service_over(root) as (url, _):
            yield from _look(engine, url, key, pages)


@contextmanager
def service_over(root: Path) -> Iterator[tuple[str, str]]:
    """Yield address and first key of a service over the folder ``root``; it may be opened anew over the same."""
    environment = os.environ | {"MAGCAL_DATA_DIR": str(root / "data")}
    command = [str(Path(sys.executable).with_name("magcal")), "serve", "--port", "0", "--workers", "1"]
    with (root / "out").open("a") as out, (root / "log").open("w") as log:
        process = subprocess.Popen(command, stdout=out, stderr=log, env=environment, cwd=root)
    try:
        while not (lines := [line for line in (root / "log").read_text().splitlines() if '"listening"' in line]):
            if process.poll() is not None:
                raise RuntimeError((root / "log").read_text())
            time.sleep(0.1)
        yield json.loads(lines[0])["url"], (root / "out").read_text().split()[2]
    finally:
        process.terminate()
        process.wait(timeout=60)


def _fill(url: str, key: str) -> dict[str, str]:
    session = SESSIONS[0]
    telemetry = simulate(Sgp4Orbit(tle_of(session)), session.sensor, session.start_utc, float(SAMPLES), 1.0, seed=1)
    headers = {"Authorization": f"Bearer {key}"}
    with httpx2.Client(base_url=f"{url}/api/v1", headers=headers, timeout=300.0) as service:
        service.post("/satellites", json={"id": "bench"}).raise_for_status()
        service.post("/satellites/bench/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        service.post("/satellites/bench/orbits", content=tle_text(), headers={"Content-Type": "text/plain"})
        kind = {"Content-Type": "application/vnd.apache.parquet"}
        body = write_samples(telemetry.samples, "parquet")
        sent = service.post("/satellites/bench/sessions?magnetometer=mgm", content=body, headers=kind)
        session_id = sent.raise_for_status().json()["id"]
        request = {"kind": "calibration", "session_ids": [session_id]}
        job = service.post("/jobs", json=request).raise_for_status().json()
        while job["state"] in {"queued", "running"}:
            time.sleep(0.2)
            job = service.get(f"/jobs/{job['id']}").json()
        set_id = job["result"]["parameter_set_id"]
        service.post(f"/parameter-sets/{set_id}/activate").raise_for_status()
    return {
        "overview": "/",
        f"satellite with {SETS} parameter sets": "/satellites/bench",
        f"session of {SAMPLES} samples": f"/sessions/{session_id}",
        f"parameter set of {SAMPLES} samples": f"/parameter-sets/{set_id}",
        "jobs": "/jobs",
    }


def _multiply(database: Path) -> None:
    """Copy the one parameter set and its job until there are `SETS`, a day and a little noise apart."""
    rng = np.random.default_rng(1)
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.row_factory = sqlite3.Row
        found = dict(connection.execute("SELECT * FROM parameter_set").fetchone())
        job = dict(connection.execute("SELECT * FROM job").fetchone())
        record = json.loads(found["record"])
        start = np.array(record["data_from"].rstrip("Z"), "M8[us]")
        for number in range(1, SETS):
            begin = str(start - np.array(number, "m8[D]"))
            record["data_from"], record["data_until"] = f"{begin}Z", f"{begin}Z"
            record["parameters"]["bias_nt"] = (np.array([2928.0, -1191.0, -1876.0]) + rng.normal(0, 8, 3)).tolist()
            job_id = f"{number:032x}"
            _insert(connection, "job", job | {"id": job_id})
            times = {"data_from": begin.replace("T", " "), "data_until": begin.replace("T", " ")}
            copy = {"id": job_id, "job_id": job_id, "status": "candidate", "record": json.dumps(record)}
            _insert(connection, "parameter_set", found | copy | times)


def _insert(connection: sqlite3.Connection, table: str, row: dict[str, object]) -> None:
    places = ", ".join("?" for _ in row)
    columns = ", ".join(f'"{name}"' for name in row)
    connection.execute(f"INSERT INTO {table} ({columns}) VALUES ({places})", list(row.values()))  # noqa: S608


def _look(engine: str, url: str, key: str, pages: dict[str, str]) -> Iterator[Figure]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=engine, args=FLAGS)
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        page.add_init_script(NUMBERS)
        page.add_init_script(ASKED)
        page.goto(url)
        page.get_by_label("Key").fill(key)
        page.get_by_role("button", name="Sign in").click()
        page.get_by_role("button", name="Sign out").wait_for()
        for name, path in pages.items():
            numbers, answered, drawn = [], [], []
            for _ in range(ROUNDS + 1):
                _rest(page)
                page.goto(url + path, wait_until="commit")
                page.wait_for_function("() => window.numbersMs")
                answered.append(page.evaluate("() => performance.now()") / 1e3)
                numbers.append(page.evaluate("() => window.numbersMs") / 1e3)
                if "satellite" in name or "set" in name or "session" in name:
                    page.locator(".plot").first.scroll_into_view_if_needed()
                    page.locator(".plot[data-drawn]").first.wait_for(timeout=60_000)
                    drawn.append(page.evaluate("() => performance.now()") / 1e3)
            first, told = (statistics.median(times[1:]) for times in (numbers, answered))
            what, is_met, note = f"{name}: first numbers", first < NUMBERS_AIM_S, f"driver answered after {told:.2f} s"
            yield Figure(ROOM, what, first, "s", f"< {NUMBERS_AIM_S} s", is_met, note)
            if drawn:
                last = statistics.median(drawn[1:])
                yield Figure(ROOM, f"{name}: first figure drawn", last, "s", f"< {PLOTS_AIM_S} s", last < PLOTS_AIM_S)
        browser.close()


def _rest(page: Page) -> None:
    """Wait until the page asks for nothing and its thread is idle, so that it costs the next one nothing."""
    page.wait_for_function(QUIET, polling=100)
    page.evaluate("() => new Promise((resolve) => requestIdleCallback(resolve))")

"""Sites for faults, on each of the databases."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples

sys.path.insert(0, str(Path(__file__).parent))  # the processes of a site import what is planted in them from here

from faultsite import SEED, TRIALS, Site

from tests.faults.stem import Stems


def pytest_report_header() -> str:
    return f"faults: {TRIALS} trials of each kill, seed {SEED}"


@pytest.fixture
def new_site(tmp_path: Path, stems: Stems) -> Iterator[Callable[..., Site]]:
    """Make the test's site: empty, on SQLite unless it is given the URL of a database."""
    with ExitStack() as stack:

        def make(url: str | None = None) -> Site:
            site = Site(tmp_path, url, stems)
            stack.callback(site.stop)
            return site

        yield make


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def site(request: pytest.FixtureRequest) -> Site:
    """An empty site on each of the databases, which is there until the site's processes have ended."""
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    new_site: Callable[..., Site] = request.getfixturevalue("new_site")
    return new_site(url)


@pytest.fixture(scope="session")
def telemetry() -> bytes:
    return write_samples(simulated(SESSIONS[0]).samples, "csv")

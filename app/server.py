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
from app.errors import ServiceError, UnavailableError
from app.http.bounded_protocol import protocol_of
from app.http.services import services_of
from app.logs import configure_logs
from app.main import Services, create_app
from app.settings import Settings
from app.storage.database import Database
from app.storage.identity import refuse_lost
from app.storage.migration import set_up
from app.storage.open_store import open_store

BACKLOG: Final = 2048

log = structlog.get_logger()


class AddressError(ServiceError):
    """The address that the service is to listen on cannot be had."""

    code = "address"


def prepare(settings: Settings) -> str | None:
    """Bring the database up to date and return the first admin key where this made it.

    Raises
    ------
    WrongStoreError
        Database, store and data folder do not belong together; nothing was made.
    """
    refuse_lost(settings)
    store = open_store(settings)
    database = Database(settings)
    try:
        set_up(database, store, settings)
        return make_first_key(database, settings)
    finally:
        database.close()


def server_of(settings: Settings) -> uvicorn.Server:
    """Return the HTTP server of a prepared database, not yet listening."""
    application = create_app(settings, workers=0 if settings.is_postgres else settings.workers)
    config = uvicorn.Config(
        application,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=True,
        timeout_graceful_shutdown=30,
        http=protocol_of(settings),
        ws="none",
    )
    server = uvicorn.Server(config)
    services_of(application, Services).stopping.learn_from(lambda: server.should_exit)
    return server


def bind(host: str, port: int) -> socket.socket:
    """Return a socket that has its address, and does not listen yet.

    Raises
    ------
    AddressError
        The address is another process's, or none of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise AddressError(f"cannot listen on {host}:{port} (MAGCAL_HOST, MAGCAL_PORT): {error.strerror}") from error
    return bound


def listen(host: str, port: int, bound: socket.socket | None = None) -> socket.socket:
    """Return a listening socket whose connections send each answer at once; ``bound`` where it has its address.

    asyncio turns Nagle's algorithm off only for sockets that were made with TCP's protocol number; with it, an answer's
    body waits some 40 ms for the acknowledgement of its headers.
    """
    listener = bind(host, port) if bound is None else bound
    listener.listen(BACKLOG)
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
    """Serve until SIGTERM or SIGINT, then let what is in flight end.

    Raises
    ------
    AddressError
        The address is taken; no database was made or changed.
    """
    configure_logs(settings)
    bound = bind(settings.host, settings.port)
    key = prepare(settings)
    if key is not None:
        sys.stdout.write(f"admin key: {key}\n")
        sys.stdout.flush()
    server = server_of(settings)
    listener = listen(settings.host, settings.port, bound)
    url = address_of(listener)
    sys.stdout.write(f"dashboard: {url}/\n")
    sys.stdout.flush()
    log.info("listening", url=url)
    _run(server, listener)


def address_of(listener: socket.socket) -> str:
    """Return where a browser on this machine finds what ``listener`` listens on."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

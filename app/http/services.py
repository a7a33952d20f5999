"""What the application holds from start to stop, as the endpoints of each room see it.

There is one value, `app.main.Services`. A room declares, beside the classes themselves, what it needs of it as a frozen
dataclass; `Services` inherits them all. So a room knows the parts of the rooms below it and no others, and a type
checker follows every use. They have no slots, which several bases cannot have at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from fastapi import FastAPI, Request, Response

from app.http.allowed_methods import Methods
from app.http.receiving import Admission
from app.settings import Settings
from app.storage.database import Database
from app.storage.store import Store


class Stopping:
    """Whether the process has been asked to stop, which answers without an end of their own ask for.

    The server, which knows, is made after the application.
    """

    def __init__(self) -> None:
        self._ask: Callable[[], bool] = lambda: False

    def learn_from(self, ask: Callable[[], bool]) -> None:
        """Let ``ask`` say it from now on."""
        self._ask = ask

    def is_asked(self) -> bool:
        """Return whether the process is to stop."""
        return self._ask()


@dataclass(frozen=True, kw_only=True)
class HttpServices:
    """What every room has."""

    settings: Settings
    database: Database
    store: Store
    admission: Admission
    methods: Methods
    stopping: Stopping
    unknown_page: Callable[[Request], Response]


Room = TypeVar("Room")


def install(app: FastAPI, services: object) -> None:
    """Let ``app`` hold ``services``."""
    app.state.services = services


def services_of(app: FastAPI, room: type[Room]) -> Room:
    """Return what ``app`` holds, as ``room`` sees it.

    Raises
    ------
    TypeError
        The application was made without what the room needs.
    """
    held: object = app.state.services
    if not isinstance(held, room):
        raise TypeError(f"the application holds no {room.__name__}")
    return held

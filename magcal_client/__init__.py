"""The client of a magcal service: `Client` blocks, `AsyncClient` awaits; `magcal-push` sends a station's files.

What is heavy is loaded when it is asked for.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from magcal_client.asynchronous import AsyncClient as AsyncClient
    from magcal_client.blocking import Client as Client
    from magcal_client.errors import ClientError as ClientError
    from magcal_client.errors import JobFailedError as JobFailedError
    from magcal_client.errors import ServiceAnswerError as ServiceAnswerError
    from magcal_client.errors import ServiceUnreachableError as ServiceUnreachableError
    from magcal_client.events import Event as Event

_PLACES = {
    "AsyncClient": "asynchronous",
    "Client": "blocking",
    "ClientError": "errors",
    "Event": "events",
    "JobFailedError": "errors",
    "ServiceAnswerError": "errors",
    "ServiceUnreachableError": "errors",
}


def __getattr__(name: str) -> object:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)

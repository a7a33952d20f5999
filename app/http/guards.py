"""Who may call is found out before the body of a request is read."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from typing import Final

from fastapi import Request
from fastapi.dependencies.models import Dependant

MARK: Final = "scopes"
"""Attribute by which a dependency tells that it guards a call."""
Guard = Callable[[Request, object], Awaitable[object]]


def guards_of(dependant: Dependant) -> list[Guard]:
    """Return the guards among what a call depends on."""
    inner = [guard for one in dependant.dependencies for guard in guards_of(one)]
    own: Guard | None = dependant.call if MARK in getattr(dependant.call, "__dict__", {}) else None
    return inner if own is None else [*inner, own]


async def admit(request: Request, guards: Sequence[Guard]) -> None:
    """Raise where the caller may not pass one of ``guards``; each remembers whom it has let pass."""
    for guard in guards:
        await guard(request, None)

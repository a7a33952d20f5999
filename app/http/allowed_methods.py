"""Which methods a path has: what a 405 must name in ``Allow`` (RFC 9110, 15.5.6)."""

from __future__ import annotations

import re
from collections.abc import Sequence

from fastapi import APIRouter
from fastapi.routing import APIRoute
from starlette.routing import compile_path


class Methods:
    """The methods of every path of some routers, each under its prefix."""

    def __init__(self, routers: Sequence[tuple[str, APIRouter]]) -> None:
        self._known: list[tuple[re.Pattern[str], frozenset[str]]] = [
            (compile_path(prefix + route.path)[0], frozenset(route.methods or ()))
            for prefix, router in routers
            for route in router.routes
            if isinstance(route, APIRoute)
        ]

    def of(self, path: str) -> list[str]:
        """Return the methods that ``path`` has, in alphabetical order; GET brings HEAD with it."""
        known = {method for pattern, methods in self._known if pattern.match(path) for method in methods}
        return sorted(known | {"HEAD"} if "GET" in known else known)

"""The dashboard's own files and the plot library, at addresses that change with them: a browser loads each once."""

from __future__ import annotations

import gzip
import hashlib
import re
from collections.abc import Collection
from functools import cache
from importlib import resources
from importlib.metadata import version
from typing import Final

from fastapi import APIRouter, Request, Response

from app.reporting.figures.page import plotly_source

router = APIRouter(include_in_schema=False)

PLOTLY_CHANGE: Final = "m1"
"""Changes with what magcal leaves out of the plot library, so that no browser keeps what it had before."""
FOR_A_YEAR: Final = "public, max-age=31536000, immutable"
STATIC_TYPES: Final = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
IMPORTED: Final = re.compile(r'from "\./([\w.]+)"')


@cache
def _static() -> dict[str, tuple[bytes, str, str]]:
    """Return name -> content, media type and ETag of the dashboard's own files, read once."""
    found = {}
    for path in (resources.files("app.dashboard") / "static").iterdir():
        suffix = "." + path.name.rpartition(".")[2]
        if suffix in STATIC_TYPES:
            content = path.read_bytes()
            found[path.name] = content, STATIC_TYPES[suffix], f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return found


def names() -> Collection[str]:
    """Return the names of the dashboard's own files."""
    return _static().keys()


@cache
def static_version() -> str:
    """Return what names the dashboard's files as they are now, 16 hexadecimal digits."""
    told = "\n".join(f"{name} {tag}" for name, (_, _, tag) in sorted(_static().items()))
    return hashlib.sha256(told.encode()).hexdigest()[:16]


@cache
def plotly_version() -> str:
    """Return what names the plot library as it is served: its package's version, and that of what is left out."""
    return f"{version('plotly')}-{PLOTLY_CHANGE}"


@cache
def modules(name: str) -> list[str]:
    """Return the modules that ``name`` imports and those that they import, so that they can be loaded side by side."""
    found = [name]
    for one in found:
        found += [new for new in dict.fromkeys(IMPORTED.findall(_static()[one][0].decode())) if new not in found]
    return found[1:]


@router.get("/static/{named_version}/{name}")
def static_file(named_version: str, name: str, request: Request) -> Response:
    """Serve a file of the dashboard.

    A page of another version, such as one that a server still to be replaced has given, gets the file too, not to keep.
    """
    if name not in _static():
        return Response(status_code=404)
    content, media_type, etag = _static()[name]
    kept = FOR_A_YEAR if named_version == static_version() else "no-cache"
    headers = {"ETag": etag, "Cache-Control": kept, "X-Content-Type-Options": "nosniff"}
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=media_type)


@router.get("/assets/plotly-{named_version}.min.js")
def plotly_asset(named_version: str, request: Request) -> Response:
    """Serve the plot library from its package."""
    etag = f'"plotly-{plotly_version()}"'
    headers = {"ETag": etag, "Cache-Control": FOR_A_YEAR, "Vary": "Accept-Encoding"}
    if named_version != plotly_version():
        return Response(status_code=404)
    if request.headers.get("if-none-match") == etag:
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        headers["Content-Encoding"] = "gzip"
        return Response(_plotly_gzip(), headers=headers, media_type="text/javascript; charset=utf-8")
    return Response(_plotly(), headers=headers, media_type="text/javascript; charset=utf-8")


def _plotly() -> bytes:
    return plotly_source().encode()


@cache
def _plotly_gzip() -> bytes:
    return gzip.compress(_plotly(), 6, mtime=0)

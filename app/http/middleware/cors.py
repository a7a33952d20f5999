"""Front-ends of other origins: those that the operator has listed may call the API from a browser, nobody else."""

from __future__ import annotations

from typing import Final

from fastapi import FastAPI
from starlette.middleware.cors import CORSMiddleware

from app.settings import Settings

METHODS: Final = ("GET", "HEAD", "POST", "PATCH", "DELETE")
SENT: Final = (
    "Authorization", "Content-Type", "Content-Encoding", "Content-Digest", "Idempotency-Key", "If-None-Match",
    "Last-Event-ID", "X-Request-ID",
)  # fmt: skip
READ: Final = (
    "ETag",
    "Location",
    "Retry-After",
    "X-Request-ID",
    "RateLimit-Limit",
    "RateLimit-Remaining",
    "RateLimit-Reset",
)
PREFLIGHT_S: Final = 3600


def origins_of(settings: Settings) -> list[str]:
    """Return the origins that are listed, such as https://ops.example.org."""
    return [one.strip().rstrip("/") for one in settings.cors_origins.split(",") if one.strip()]


def allow_origins(app: FastAPI, settings: Settings) -> None:
    """Let the listed origins call the API with a key; the dashboard's cookie is sent to none of them."""
    origins = origins_of(settings)
    if origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=origins,
            allow_methods=METHODS,
            allow_headers=SENT,
            expose_headers=READ,
            allow_credentials=False,
            max_age=PREFLIGHT_S,
        )

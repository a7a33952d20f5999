"""Structured logs on stderr, each line with the ids of its request and job, never with a secret."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import MutableMapping
from typing import Final

import structlog

from app.settings import Settings

KEY: Final = re.compile(r"mgc_([0-9a-f]{16})_[A-Za-z0-9_-]{20,}")
LEVELS: Final = {"debug": 10, "info": 20, "warning": 30, "error": 40}

log = structlog.get_logger()


def configure_logs(settings: Settings) -> None:
    """Send this process's logs, the libraries' too, to stderr in the form that the settings want."""
    last: structlog.types.Processor = (
        structlog.processors.JSONRenderer() if settings.log_format == "json" else structlog.dev.ConsoleRenderer()
    )
    shared: list[structlog.types.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.format_exc_info,
        _hide_keys,
    ]
    structlog.configure(
        processors=[*shared, last],
        wrapper_class=structlog.make_filtering_bound_logger(LEVELS[settings.log_level]),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(processor=last, foreign_pre_chain=shared))
    logging.basicConfig(handlers=[handler], level=max(LEVELS[settings.log_level], logging.WARNING), force=True)


def _hide_keys(_logger: object, _name: str, event: MutableMapping[str, object]) -> MutableMapping[str, object]:
    for name, value in event.items():
        if isinstance(value, str) and "mgc_" in value:
            event[name] = KEY.sub(r"mgc_\1_...", value)
    return event

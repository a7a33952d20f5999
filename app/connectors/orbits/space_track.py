"""Space-Track's classes ``gp`` and ``gp_history``: OMM in JSON, with a login; 30 requests a minute and 300 an hour."""

from __future__ import annotations

import json
from datetime import date
from typing import TYPE_CHECKING

from app.connectors.http import SourceClient, SourceContentError, require_no_page
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from app.settings import Settings


class SpaceTrack:
    """A login and a query a satellite: two requests, so half of the limits each."""

    limits: tuple[Limit, ...] = (Limit(15, 60.0), Limit(150, 3600.0))

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return the newest elements of a satellite."""
        query = f"class/gp/NORAD_CAT_ID/{watched.catalogue_number}/orderby/EPOCH%20desc/limit/1/format/json"
        body = _answer(settings, query)
        if not _elements(body):
            raise SourceContentError("Space-Track has no elements of this catalogue number")
        return Reply(body, "application/json")

    def ask_between(self, settings: Settings, watched: Watched, first: date, last: date) -> Reply | None:
        """Return the elements with epochs from the day ``first`` up to the day ``last``."""
        query = (
            f"class/gp_history/NORAD_CAT_ID/{watched.catalogue_number}/EPOCH/{first}--{last}/orderby/EPOCH%20asc/"
            "format/json"
        )
        body = _answer(settings, query)
        return Reply(body, "application/json") if _elements(body) else None


def _answer(settings: Settings, query: str) -> bytes:
    """Return what Space-Track answers to a query, behind a login of its own."""
    base = settings.space_track_url.rstrip("/")
    if settings.space_track_user is None or settings.space_track_password_file is None:
        raise SourceContentError("MAGCAL_SPACE_TRACK_USER and MAGCAL_SPACE_TRACK_PASSWORD_FILE are not set")
    try:
        password = settings.space_track_password_file.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise SourceContentError(f"MAGCAL_SPACE_TRACK_PASSWORD_FILE cannot be read: {error.strerror}") from error
    client = SourceClient(base)
    try:
        client.post(f"{base}/ajaxauth/login", {"identity": settings.space_track_user, "password": password})
        return require_no_page(client.get(f"{base}/basicspacedata/query/{query}"))
    finally:
        client.close()


def _elements(body: bytes) -> list[object]:
    """Return the elements that ``body`` holds; Space-Track tells errors with 200, too."""
    try:
        found = json.loads(body)
    except ValueError:
        raise SourceContentError("the answer is not JSON") from None
    if not isinstance(found, list):
        raise SourceContentError("the answer is not a list of elements")
    if found and isinstance(found[0], dict) and "error" in found[0]:
        raise SourceContentError("Space-Track answered with an error in place of elements")
    return found

"""Space-Track's class ``gp``: OMM in JSON, with a login; 30 requests a minute and 300 an hour at the most."""

from __future__ import annotations

import json

from app.connectors.http import SourceClient, SourceContentError, require_no_page
from app.connectors.orbits.contract import Limit, Reply, Watched, catalogue_number
from app.settings import Settings


class SpaceTrack:
    """A login and a query a satellite: two requests, so half of the limits each."""

    limits: tuple[Limit, ...] = (Limit(15, 60.0), Limit(150, 3600.0))

    def ask(self, settings: Settings, satellite: Watched) -> Reply:
        """Return the newest elements of a satellite."""
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
            number = catalogue_number(satellite)
            query = f"class/gp/NORAD_CAT_ID/{number}/orderby/EPOCH%20desc/limit/1/format/json"
            body = client.get(f"{base}/basicspacedata/query/{query}")
        finally:
            client.close()
        return Reply(_elements(require_no_page(body)), "application/json")


def _elements(body: bytes) -> bytes:
    """Return ``body`` where it holds elements; Space-Track tells errors with 200, too."""
    try:
        found = json.loads(body)
    except ValueError:
        raise SourceContentError("the answer is not JSON") from None
    if not isinstance(found, list) or not found:
        raise SourceContentError("Space-Track has no elements of this catalogue number")
    if isinstance(found[0], dict) and "error" in found[0]:
        raise SourceContentError("Space-Track answered with an error in place of elements")
    return body

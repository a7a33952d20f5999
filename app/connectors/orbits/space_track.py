"""Space-Track's classes ``gp`` and ``gp_history``: OMM in JSON, with a login; 30 requests a minute and 300 an hour.

The queries are those of the package ``spacetrack``, an extra, over a client of ours: it reaches the one host of the
settings, and an answer but 200 is an error before the package can ask again or follow it elsewhere.
"""

from __future__ import annotations

import json
from datetime import date
from typing import TYPE_CHECKING

from app.connectors.errors import SourceAnswerError, SourceContentError, require_no_page
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from spacetrack import SpaceTrackClient

    from app.settings import Settings


class SpaceTrack:
    """A login and a query a satellite: two requests, so half of the limits each."""

    limits: tuple[Limit, ...] = (Limit(15, 60.0), Limit(150, 3600.0))
    package: str | None = "spacetrack"

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return the newest elements of a satellite."""
        body = _answer(settings, "gp", NORAD_CAT_ID=watched.catalogue_number, orderby="EPOCH desc", limit=1)
        if not _elements(body):
            raise SourceContentError("Space-Track has no elements of this catalogue number")
        return Reply(body, "application/json")

    def ask_between(self, settings: Settings, watched: Watched, first: date, last: date) -> Reply | None:
        """Return the elements with epochs from the day ``first`` up to the day ``last``."""
        from spacetrack.operators import inclusive_range

        epochs = inclusive_range(first, last)
        body = _answer(settings, "gp_history", NORAD_CAT_ID=watched.catalogue_number, EPOCH=epochs, orderby="EPOCH asc")
        return Reply(body, "application/json") if _elements(body) else None


def _answer(settings: Settings, name: str, **predicates: object) -> bytes:
    """Return what Space-Track answers to a query of the class ``name``, behind a login of its own.

    Raises
    ------
    SourceAnswerError, SourceUnreachableError, SourceContentError
        Those of `app.connectors.errors`; a login that fails with 200 stops the source, too.
    """
    from spacetrack import AuthenticationError

    with _opened(settings) as client:
        try:
            text = client.generic_request(name, controller="basicspacedata", format="json", **predicates)
        except AuthenticationError:
            raise SourceAnswerError(200, "but the login failed: is the user or the password wrong?") from None
        except ValueError:
            raise SourceContentError("the answer to the login is not Space-Track's") from None
    return require_no_page(str(text).encode())


def _opened(settings: Settings) -> SpaceTrackClient:
    """Return a client that sends a login with its first query, then queries, and nothing else."""
    from spacetrack import SpaceTrackClient

    from app.connectors.one_host import client_of

    if settings.space_track_user is None or settings.space_track_password_file is None:
        raise SourceContentError("MAGCAL_SPACE_TRACK_USER and MAGCAL_SPACE_TRACK_PASSWORD_FILE are not set")
    try:
        password = settings.space_track_password_file.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise SourceContentError(f"MAGCAL_SPACE_TRACK_PASSWORD_FILE cannot be read: {error.strerror}") from error

    class TwoRequests(SpaceTrackClient):  # type: ignore[misc]  # the package has no types
        # Predicates that are known here are not asked for with a request of its own.
        offline_predicates = SpaceTrackClient.offline_predicates | {
            ("gp", "basicspacedata"): {"NORAD_CAT_ID"},
            ("gp_history", "basicspacedata"): {"NORAD_CAT_ID", "EPOCH"},
        }

        def logout(self) -> None:
            """Send nothing: a login ends by itself, and requests are counted."""

    base = settings.space_track_url
    return TwoRequests(settings.space_track_user, password, base_url=base, httpx_client=client_of(base))


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

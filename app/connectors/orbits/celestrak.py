"""CelesTrak's general perturbations: OMM in JSON, the only form with catalogue numbers beyond 99999."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from app.connectors.errors import SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from app.settings import Settings

PATH: Final = "/NORAD/elements/gp.php"


class CelesTrak:
    """``gp.php?CATNR=N&FORMAT=json``; its data change three times a day, and who asks too often is shut out."""

    limits: tuple[Limit, ...] = ()
    package: str | None = None

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return the newest elements of a satellite."""
        base = settings.celestrak_url.rstrip("/")
        url = base if urlsplit(base).path.endswith(".php") else f"{base}{PATH}"
        client = SourceClient(url)
        try:
            body = client.get(url, {"CATNR": watched.catalogue_number, "FORMAT": "json"})
        finally:
            client.close()
        if require_no_page(body).lstrip()[:1] != b"[":
            raise SourceContentError("CelesTrak has no elements of this catalogue number")
        return Reply(body, "application/json")

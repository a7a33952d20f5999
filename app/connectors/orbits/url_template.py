"""Any server that answers an orbit message at an address with the catalogue number in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.connectors.errors import SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from app.settings import Settings


class UrlTemplate:
    """``MAGCAL_ORBIT_URL`` with ``{norad_id}`` in it."""

    limits: tuple[Limit, ...] = ()
    package: str | None = None

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return what is at the satellite's address."""
        if settings.orbit_url is None or "{norad_id}" not in settings.orbit_url:
            raise SourceContentError("MAGCAL_ORBIT_URL wants an address with {norad_id} in it")
        url = settings.orbit_url.replace("{norad_id}", watched.catalogue_number)
        client = SourceClient(url)
        try:
            body = require_no_page(client.get(url))
        finally:
            client.close()
        return Reply(body, "application/json" if body.lstrip()[:1] in {b"[", b"{"} else "text/plain")

"""SatNOGS DB's two-line elements: JSON with ``tle0``, ``tle1``, ``tle2``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from app.connectors.errors import SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.orbits.contract import Limit, Reply, Watched

if TYPE_CHECKING:
    from app.settings import Settings


class SatNogs:
    """``/api/tle/?norad_cat_id=N&format=json``, which needs no token."""

    limits: tuple[Limit, ...] = (Limit(30, 60.0),)
    package: str | None = None

    def ask(self, settings: Settings, watched: Watched) -> Reply:
        """Return the elements that SatNOGS holds the best of a satellite's."""
        base = settings.satnogs_url.rstrip("/")
        client = SourceClient(base)
        try:
            body = client.get(f"{base}/api/tle/", {"norad_cat_id": watched.catalogue_number, "format": "json"})
        finally:
            client.close()
        try:
            found = json.loads(require_no_page(body))
            texts = ["\n".join((one["tle0"], one["tle1"], one["tle2"])) for one in found]
        except (ValueError, TypeError, KeyError):
            raise SourceContentError("the answer is not SatNOGS' list of tle0, tle1, tle2") from None
        if not texts:
            raise SourceContentError("SatNOGS has no elements of this catalogue number")
        return Reply(("\n".join(texts) + "\n").encode(), "text/plain")

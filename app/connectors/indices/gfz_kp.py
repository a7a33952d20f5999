"""Kp of GFZ, Potsdam: the nowcast of the last month, or the whole series since 1932; CC BY 4.0."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Final

from app.connectors.indices.contract import IndexPart

if TYPE_CHECKING:
    from app.settings import Settings

NOWCAST: Final = timedelta(days=28)
"""So far back the nowcast's file reaches; it has the last 30 days."""


class GfzKp:
    """The files that GFZ publishes, in its own format."""

    index_name: str = "Kp"

    def parts(self, settings: Settings, since: datetime, now: datetime) -> Sequence[IndexPart]:
        """Return the nowcast where it reaches back to ``since``, else the whole series."""
        name = "Kp_ap_nowcast.txt" if now - since <= NOWCAST else "Kp_ap_since_1932.txt"
        return [IndexPart(name, f"{settings.gfz_url.rstrip('/')}/app/files/{name}")]

"""Dst of the World Data Center for Geomagnetism, Kyoto: the quicklook, a file a month.

For commercial use the Center asks to be asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Final

from app.connectors.indices.contract import IndexPart

if TYPE_CHECKING:
    from app.settings import Settings

SETTLES: Final = timedelta(days=45)
"""So long after its month the quicklook is still renewed."""


class KyotoDst:
    """The quicklook's files in the Center's own format of 120 columns."""

    index_name: str = "Dst"

    def parts(self, settings: Settings, since: datetime, now: datetime) -> Sequence[IndexPart]:
        """Return the months from that of ``since`` to this one."""
        found, begin = [], datetime(since.year, since.month, 1, tzinfo=UTC)
        while begin <= now:
            end = datetime(begin.year + begin.month // 12, begin.month % 12 + 1, 1, tzinfo=UTC)
            address = f"{settings.kyoto_url.rstrip('/')}/dst_realtime/{begin:%Y%m}/dst{begin:%y%m}.for.request"
            found.append(IndexPart(f"{begin:%Y-%m}", address, end + SETTLES))
            begin = end
        return found

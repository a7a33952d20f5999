"""Yamcs: ``/api/archive/{instance}:exportParameterValues``, a table of parameters over a span of time.

A server without that call, and one that is asked by history, answers parameter by parameter (`yamcs_history`).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Final

from app.connectors.errors import SourceAnswerError, SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.telemetry.contract import TIME, Page, PullOptionError, Wanted, instant, iso
from app.connectors.telemetry.yamcs_history import history_pages

SPAN: Final = timedelta(hours=6)
LATE: Final = timedelta(minutes=1)
"""What is younger may still be on its way into the archive."""
NO_SUCH_CALL: Final = frozenset({404, 405, 501})
MOST_EMPTY: Final = 8
"""After so many spans without a row the next ones are longer, so that a gap of years is passed soon."""


class Yamcs:
    """Asks span by span; a span's end is the next one's beginning and belongs to that (Yamcs: start <= t < stop)."""

    def pages(self, wanted: Wanted, mark: str | None, now: datetime) -> Iterator[Page]:
        """Yield a page a span, up to a minute ago."""
        if wanted.dataset is None:
            raise PullOptionError("yamcs wants --dataset, the name of the instance")
        begin = instant(mark) if mark is not None else wanted.since
        if begin is None:
            raise PullOptionError("the first pull wants --since")
        first, last = min(begin, wanted.again_from or begin), now - LATE
        client = SourceClient(wanted.base_url, _headers(wanted))
        try:
            pages = history_pages if wanted.by_history else self._tables
            for page in pages(client, wanted, first, last):
                yield Page(page.rows, iso(max(instant(page.mark), begin)))
        finally:
            client.close()

    def _tables(self, client: SourceClient, wanted: Wanted, begin: datetime, last: datetime) -> Iterator[Page]:
        empty = 0
        while begin < last:
            end = min(begin + SPAN * (4 ** max(0, empty - MOST_EMPTY)), last)
            try:
                rows = self._span(client, wanted, begin, end)
            except SourceAnswerError as error:
                if error.status not in NO_SUCH_CALL:
                    raise
                yield from history_pages(client, wanted, begin, last)
                return
            empty = 0 if rows else min(empty + 1, MOST_EMPTY + 4)
            yield Page(rows, iso(end))
            begin = end

    def _span(self, client: SourceClient, wanted: Wanted, begin: datetime, end: datetime) -> list[dict[str, str]]:
        url = f"{wanted.base_url.rstrip('/')}/api/archive/{wanted.dataset}:exportParameterValues"
        asked = {"start": iso(begin), "stop": iso(end), "parameters": ",".join(wanted.names), "delimiter": "TAB"}
        body = require_no_page(client.get(url, asked)).decode("utf-8", "replace")
        rows = csv.DictReader(io.StringIO(body), delimiter="\t")
        if body.strip() and "Time" not in (rows.fieldnames or []):
            raise SourceContentError("the answer is not Yamcs' table: it has no column Time")
        found: list[dict[str, str]] = []
        for row in rows:
            values = {name: _value(row, name) for name in wanted.names}
            if any(values.values()) and begin <= instant(row["Time"]) < end:
                found.append({TIME: row["Time"], **values})
        return found


def _value(row: dict[str, str], name: str) -> str:
    """Return a parameter's value; the export names columns by the path or by its last part."""
    return (row.get(name) or row.get(name.rpartition("/")[2]) or "").strip()


def _headers(wanted: Wanted) -> dict[str, str]:
    return {"authorization": f"Bearer {wanted.token}"} if wanted.token else {}

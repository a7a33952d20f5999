"""Yamcs: ``/api/archive/{instance}/parameters/{name}``, the history of one parameter, page by page with a token.

The parameters' pages end at different times: rows are kept as far as all parameters are known, and the mark is there.
A token is not kept over a kill, since it may have run out: the next pull asks from the mark.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Final
from urllib.parse import quote

from app.connectors.errors import SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.telemetry.contract import TIME, Page, Wanted, instant, iso

LIMIT: Final = 10_000
"""Values of a page; about 4 MB of JSON."""
UNKNOWN: Final = frozenset({"INVALID", "NOT_RECEIVED"})
NUMBERS: Final = ("floatValue", "doubleValue", "sint32Value", "uint32Value", "sint64Value", "uint64Value")


@dataclass(slots=True)
class _History:
    """One parameter, read as far as ``until``: every value before it is among ``values`` (time as sent, value)."""

    name: str
    start: str
    until: datetime
    token: str | None = None
    is_over: bool = False
    values: dict[datetime, tuple[str, str]] = field(default_factory=dict)


def history_pages(client: SourceClient, wanted: Wanted, begin: datetime, end: datetime) -> Iterator[Page]:
    """Yield the rows from ``begin`` up to ``end``; what was sampled at the same time is one row."""
    first = begin
    histories = [_History(name, iso(begin), begin) for name in wanted.names]
    while begin < end:
        behind = min(histories, key=lambda one: (one.is_over, one.until))
        if not behind.is_over:
            _read_on(client, wanted, behind, first, end)
        reached = min(one.until for one in histories)
        if reached > begin:
            yield Page(_rows(histories, reached), iso(reached))
            begin = reached


def _read_on(client: SourceClient, wanted: Wanted, history: _History, begin: datetime, end: datetime) -> None:
    """Read a parameter's next page.

    Raises
    ------
    SourceContentError
        The answer is not that of a history, is not in the order of time, or leads nowhere.
    """
    url = f"{wanted.base_url.rstrip('/')}/api/archive/{wanted.dataset}/parameters/{quote(history.name.lstrip('/'))}"
    asked = {"start": history.start, "stop": iso(end), "order": "asc", "limit": str(LIMIT)}
    if history.token is not None:
        asked["next"] = history.token
    try:
        document = json.loads(require_no_page(client.get(url, asked)))
        sent = [(one["generationTime"], one) for one in document.get("parameter", [])]
        token = document.get("continuationToken")
    except (ValueError, TypeError, KeyError, AttributeError):
        raise SourceContentError("the answer is not Yamcs' history of a parameter") from None
    for text, one in sent:
        time = instant(str(text))
        if time < begin:
            continue
        if time < history.until:
            raise SourceContentError(f"the history of {history.name} is not in the order of time")
        history.until = min(time, end)
        if time < end and (value := _value(one)):
            history.values[time] = (str(text), value)
    if token is not None and token == history.token and not sent:
        raise SourceContentError(f"the history of {history.name} goes on with the page that it had")
    history.token = token or None
    if history.token is None:
        history.until, history.is_over = end, True


def _value(one: dict[str, object]) -> str:
    """Return a value's number as text, empty where there is none."""
    if one.get("acquisitionStatus") in UNKNOWN:
        return ""
    for kind in ("engValue", "rawValue"):
        value = one.get(kind)
        if isinstance(value, dict):
            return next((str(value[name]) for name in NUMBERS if value.get(name) is not None), "")
    return ""


def _rows(histories: list[_History], end: datetime) -> list[dict[str, str]]:
    """Return the rows before ``end``, taken from the histories."""
    times = sorted({time for one in histories for time in one.values if time < end})
    rows: list[dict[str, str]] = []
    for time in times:
        found = {one.name: one.values.pop(time, ("", "")) for one in histories}
        rows.append({TIME: next(text for text, _ in found.values() if text)} | {n: v for n, (_, v) in found.items()})
    return rows

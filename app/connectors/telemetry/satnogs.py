"""SatNOGS DB: ``/api/telemetry/``, decoded frames, the newest first, a cursor from page to page, throttled."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from typing import Final

from app.connectors.errors import SourceAnswerError, SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.telemetry.contract import TIME, Page, PullOptionError, Wanted, instant, iso

BETWEEN_S: Final = 1.0
THROTTLED: Final = 429
_JUST: Final = timedelta(microseconds=1)
"""A walk ends before the frame at its end, and a first one is to have the frame at its beginning."""
LONGEST_WAIT_S: Final = 3600.0
Frame = dict[str, object]


class SatNogs:
    """Walks back from the newest frame to the newest of the time before.

    The mark says where that is (``since``), and in the middle of a walk also where it goes on (``next``), which frame
    it began with (``until``) and up to where walks before it have all (``reached``): a walk that is cut goes on from
    its last page.
    """

    def __init__(self, wait: Callable[[float], object] = time.sleep) -> None:
        self._wait = wait

    def pages(self, wanted: Wanted, mark: str | None, now: datetime) -> Iterator[Page]:
        """Yield page after page; the last one's mark begins the next walk."""
        if wanted.dataset is None:
            raise PullOptionError("satnogs wants the satellite's NORAD id: --dataset, or norad_id of the satellite")
        state: dict[str, str | None] = {"since": None if wanted.since is None else iso(wanted.since - _JUST)}
        state |= json.loads(mark) if mark is not None else {}
        state = _with_end(state, wanted.again_from)
        client = SourceClient(wanted.base_url, {"authorization": f"Token {wanted.token}"} if wanted.token else {})
        try:
            while True:
                frames, following = self._page(client, wanted, state)
                settled = [one for one in frames if instant(str(one["timestamp"])) <= now]
                rows, is_over = _fresh(settled, wanted, state.get("since"))
                state["until"] = state.get("until") or (str(settled[0]["timestamp"]) if settled else None)
                state["next"] = None if is_over else following
                if state["next"] is None:
                    state = {"since": _newest(state)}
                yield Page(rows, json.dumps(state))
                if state.get("next") is None:
                    return
                self._wait(BETWEEN_S)
        finally:
            client.close()

    def _page(
        self, client: SourceClient, wanted: Wanted, state: dict[str, str | None]
    ) -> tuple[list[Frame], str | None]:
        url, asked = state.get("next"), None
        if url is None:
            url = f"{wanted.base_url.rstrip('/')}/api/telemetry/"
            asked = {"satellite": str(wanted.dataset), "format": "json"}
            if state.get("since"):
                asked["start"] = str(state["since"])
        try:
            document = json.loads(require_no_page(self._patiently(client, url, asked)))
            frames = document["results"] if isinstance(document, dict) else document
            following = document.get("next") if isinstance(document, dict) else None
            if not all(isinstance(one, dict) and "timestamp" in one for one in frames):
                raise SourceContentError("a frame of the answer has no timestamp")
        except (ValueError, TypeError, KeyError):
            raise SourceContentError("the answer is not SatNOGS' list of frames") from None
        return frames, following if isinstance(following, str) else None

    def _patiently(self, client: SourceClient, url: str, asked: dict[str, str] | None) -> bytes:
        """Return the answer; where the server says "too many", after the pause that it asks for."""
        while True:
            try:
                return client.get(url, asked)
            except SourceAnswerError as error:
                if error.status != THROTTLED:
                    raise
                self._wait(min(error.retry_after_s or 60.0, LONGEST_WAIT_S))


def _with_end(state: dict[str, str | None], again_from: datetime | None) -> dict[str, str | None]:
    """Return the state of a walk with its end: where walks have reached, or before that where the pull looks back.

    Also of one that was cut while it looked back: what it took is remembered only from ``again_from`` on.
    """
    reached = state.get("reached") or state.get("since")
    if reached is None:
        return state
    end = reached if again_from is None else iso(min(again_from, instant(reached)))
    return state | {"since": end, "reached": reached}


def _newest(state: dict[str, str | None]) -> str | None:
    """Return up to where a walk that is over has all."""
    return max(
        (one for one in (state.get("until"), state.get("reached")) if one is not None), key=instant, default=None
    )


def _fresh(frames: list[Frame], wanted: Wanted, since: str | None) -> tuple[list[dict[str, str]], bool]:
    """Return the rows of the frames behind ``since``, and whether a frame was not behind it, so that the walk ends."""
    limit = None if since is None else instant(since)
    new = [one for one in frames if limit is None or instant(str(one["timestamp"])) > limit]
    rows = [{TIME: str(one["timestamp"]), **_values(one, wanted)} for one in reversed(new)]
    return [row for row in rows if any(row[name] for name in wanted.names)], len(new) < len(frames)


def _values(frame: Frame, wanted: Wanted) -> dict[str, str]:
    """Return the wanted fields of a decoded frame, a nested one as ``a.b.c``; empty where it has none."""
    decoded = frame.get("decoded")
    if isinstance(decoded, str):
        try:
            decoded = json.loads(decoded)
        except ValueError:
            decoded = None
    return {name: _field(decoded, name) for name in wanted.names}


def _field(decoded: object, name: str) -> str:
    if isinstance(decoded, dict) and name in decoded:
        found = decoded[name]
        return "" if isinstance(found, dict | list | bool) or found is None else str(found)
    for part in name.split("."):
        if not isinstance(decoded, dict):
            return ""
        decoded = decoded.get(part)
    return "" if isinstance(decoded, dict | list | bool) or decoded is None else str(decoded)

"""Server-sent events, line by line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Optional

from magcal_client.requests import Record


@dataclass(frozen=True)
class Event:
    """One event: its id, from which a stream can be gone on with; its type; its body.

    A service says the id of where a stream begins with an event of no type, which nobody is shown.
    """

    id: str
    type: str
    data: Record


class EventReader:
    """Puts lines together to events; comments, which keep a connection open, are passed over."""

    def __init__(self) -> None:
        self._fields: dict[str, str] = {}

    def take(self, line: str) -> Optional[Event]:
        """Return the event that ends with ``line``, if one does."""
        if line:
            name, _, value = line.partition(":")
            value = value[1:] if value.startswith(" ") else value
            known = self._fields.get(name)
            self._fields[name] = value if known is None or name != "data" else f"{known}\n{value}"
            return None
        found, self._fields = self._fields, {}
        if "data" not in found:
            return Event(found["id"], "", {}) if found.get("id") else None
        return Event(found.get("id", ""), found.get("event", "message"), json.loads(found["data"]))

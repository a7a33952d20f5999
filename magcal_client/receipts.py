"""A station's receipts: what it was told that the service has. They are notes, not proof: the service is asked again.

A service that was restored from yesterday's backup does not have today's passes, whatever the receipts say.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Optional


@dataclass(frozen=True)
class Receipt:
    """One file that a service acknowledged: its name and bytes, its session, and the service's database."""

    name: str
    sha256: str
    session_id: str
    satellite: str
    magnetometer: str
    database: Optional[str] = None


def read_receipts(path: Path) -> Iterator[Receipt]:
    """Yield the receipts of a file; a last line that a power cut left torn is passed over: its file is sent again."""
    if not path.exists():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            found = json.loads(line)
            database = found.get("database")
            yield Receipt(
                name=str(found["name"]),
                sha256=str(found["sha256"]),
                session_id=str(found["session_id"]),
                satellite=str(found["satellite"]),
                magnetometer=str(found["magnetometer"]),
                database=None if database is None else str(database),
            )
        except (ValueError, KeyError, AttributeError, TypeError):
            continue


def append_receipt(path: Path, receipt: Receipt) -> None:
    """Write a receipt down; it is on disk when this returns."""
    at = datetime.now(timezone.utc).isoformat(timespec="seconds").replace("+00:00", "Z")
    with path.open("a", encoding="utf-8") as receipts:
        if receipts.tell() and not _ends_a_line(path):
            receipts.write("\n")
        receipts.write(json.dumps({**asdict(receipt), "at": at}) + "\n")
        receipts.flush()
        os.fsync(receipts.fileno())


def _ends_a_line(path: Path) -> bool:
    """Return whether a file's last line is whole: what a power cut has torn must not take the next line with it."""
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"

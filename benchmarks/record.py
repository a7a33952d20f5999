"""What a run leaves in ``results/latest.json``: each room's last figures, when, where and with what they were taken."""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

LATEST: Final = Path(__file__).parent / "results" / "latest.json"
PARTS: Final = ("numpy", "scipy", "numba", "pyarrow", "sgp4", "fastapi", "uvicorn", "sqlalchemy", "procrastinate")


@dataclass(frozen=True, slots=True)
class RoomRecord:
    """One room's figures; ``load`` is how many processes wanted a processor when it began."""

    room: str
    at: str
    took_s: float
    load: float
    figures: Sequence[dict[str, object]]


def now() -> str:
    """Return the time in UTC."""
    return dt.datetime.now(dt.UTC).isoformat(timespec="seconds")


def read_latest() -> dict[str, object]:
    """Return the latest record, empty where there is none of this form."""
    record = json.loads(LATEST.read_text()) if LATEST.exists() else {}
    return record if "rooms" in record else {"rooms": {}}


def update_latest(room: RoomRecord) -> None:
    """Put a room's figures in the place of its former ones."""
    rooms = read_latest()["rooms"]
    record = {
        "machine": {"processor": _processor(), "cores": os.cpu_count(), "system": platform.platform(terse=True)},
        "versions": {"python": platform.python_version()} | {name: version(name) for name in PARTS},
        "rooms": {**(rooms if isinstance(rooms, dict) else {}), room.room: asdict(room)},
    }
    LATEST.parent.mkdir(exist_ok=True)
    LATEST.write_text(json.dumps(record, indent=1) + "\n")


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())

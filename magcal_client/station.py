"""A ground station's folder: every telemetry file in it reaches the service, whatever fails meanwhile.

The folder itself is the record. A file stays where the receiver wrote it until the service has acknowledged its bytes;
then the acknowledgement is written down (``sent/receipts.ndjson``, forced to disk) and only then the file is moved to
``sent/``. A kill between any two of these steps leaves a file that is sent again or only moved, never one that is lost;
the same bytes sent again are the same session.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from magcal_client.blocking import Client
from magcal_client.errors import FolderTakenError, ServiceAnswerError, ServiceUnreachableError
from magcal_client.requests import format_of_name, media_type_of

SENT: Final = "sent"
REFUSED: Final = "refused"
RECEIPTS: Final = "receipts.ndjson"
LOCK: Final = ".magcal-push.lock"
WILL_NEVER_DO: Final = frozenset({400, 413, 415, 422})
"""Answers that the same bytes would get again: the file is put aside."""
NOT_NOW: Final = frozenset({401, 403, 429, 502, 503, 504, 507})
"""Answers that every other file would get now too: the round ends."""


@dataclass(frozen=True)
class Destination:
    """Whose telemetry the files are."""

    satellite: str
    magnetometer: str


@dataclass(frozen=True)
class Outcome:
    """What became of a file: ``sent`` (with its session), ``refused`` or ``kept`` (with the reason)."""

    name: str
    state: str
    session_id: str | None = None
    why: str | None = None
    ends_round: bool = False


@dataclass(frozen=True)
class _Look:
    """What tells two states of a file apart."""

    inode: int
    size: int
    changed_ns: int

    @classmethod
    def at(cls, path: Path) -> _Look | None:
        try:
            found = path.stat()
        except FileNotFoundError:
            return None
        return cls(found.st_ino, found.st_size, found.st_mtime_ns)


class Station:
    """The files of one magnetometer in ``folder``, and how they reach a service through ``client``."""

    def __init__(self, folder: Path, client: Client, destination: Destination, *, settle_s: float) -> None:
        self._folder = folder
        self._client = client
        self._destination = destination
        self._settle_s = settle_s
        self._looks: dict[Path, tuple[_Look, float]] = {}
        for name in (SENT, REFUSED):
            (folder / name).mkdir(exist_ok=True)
        self._receipts = _read_receipts(folder / SENT / RECEIPTS, destination)

    def send_all(self) -> Iterator[Outcome]:
        """Send every file that is whole, the oldest first, and yield what became of each; stop where nobody answers.

        Whole is what has not changed for the settling time and what nobody has open for writing.
        """
        self.look()
        now_s = time.monotonic()
        settled = [path for path, (_, since_s) in self._looks.items() if now_s - since_s >= self._settle_s]
        for path in sorted(settled, key=lambda path: (self._looks[path][0].changed_ns, path.name)):
            if _is_being_written(path):
                continue
            outcome = self._send(path)
            if outcome is None:
                continue
            yield outcome
            if outcome.ends_round:
                return

    def look(self) -> None:
        """See which files there are, and since when each is as it is."""
        now_s = time.monotonic()
        looks: dict[Path, tuple[_Look, float]] = {}
        for path in self._folder.iterdir():
            if path.name.startswith(".") or format_of_name(path) is None or not path.is_file():
                continue
            look = _Look.at(path)
            if look is None:
                continue
            before = self._looks.get(path)
            looks[path] = before if before is not None and before[0] == look else (look, now_s)
        self._looks = looks

    def _send(self, path: Path) -> Outcome | None:
        """Return what became of a file; None where it changed or went away while it was looked at."""
        look = _Look.at(path)
        try:
            content = path.read_bytes()
        except OSError as error:
            return None if look is None else Outcome(path.name, "kept", why=str(error))
        if look is None or _Look.at(path) != look:
            return None
        digest = hashlib.sha256(content).hexdigest()
        session_id = self._receipts.get(digest)
        try:
            if session_id is None:
                session_id = self._upload(path, content, digest)
        except ServiceUnreachableError as error:
            return Outcome(path.name, "kept", why=f"{error.code}: {error.message}", ends_round=True)
        except ServiceAnswerError as error:
            return self._refused(path, digest, error)
        if _Look.at(path) != look:
            return None  # it has grown since: what is there now is sent when it has settled
        self._put(path, SENT, digest)
        return Outcome(path.name, "sent", session_id=session_id)

    def _upload(self, path: Path, content: bytes, digest: str) -> str:
        """Return the session that a file became, once its acknowledgement is on disk."""
        to = self._destination
        session = self._client.upload(to.satellite, to.magnetometer, content, media_type_of(path))
        session_id = str(session["id"])
        self._acknowledge(path.name, digest, session_id)
        return session_id

    def _refused(self, path: Path, digest: str, error: ServiceAnswerError) -> Outcome:
        why = f"{error.code}: {error.message}"
        if error.status not in WILL_NEVER_DO:
            return Outcome(path.name, "kept", why=why, ends_round=error.status in NOT_NOW)
        target = self._put(path, REFUSED, digest)
        reasons = "\n".join([why, *error.faults])
        target.with_name(f"{target.name}.why").write_text(f"{reasons}\n", encoding="utf-8")
        return Outcome(path.name, "refused", why=why)

    def _acknowledge(self, name: str, digest: str, session_id: str) -> None:
        at = datetime.now(timezone.utc).isoformat(timespec="seconds").replace("+00:00", "Z")
        receipt = {"name": name, "sha256": digest, "session_id": session_id, "at": at, **asdict(self._destination)}
        with (self._folder / SENT / RECEIPTS).open("a", encoding="utf-8") as receipts:
            receipts.write(json.dumps(receipt) + "\n")
            receipts.flush()
            os.fsync(receipts.fileno())
        self._receipts[digest] = session_id

    def _put(self, path: Path, place: str, digest: str) -> Path:
        """Move a file aside; another one of its name that lies there already keeps its own."""
        target = self._folder / place / path.name
        if target.exists() and hashlib.sha256(target.read_bytes()).hexdigest() != digest:
            target = target.with_name(f"{digest[:12]}-{path.name}")
        path.rename(target)
        for folder in (target.parent, self._folder):
            _force_to_disk(folder)
        return target


@contextmanager
def taken(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the operating system gives it back whatever ends the process.

    Raises
    ------
    FolderTakenError
        Another process holds it.
    """
    with (folder / LOCK).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderTakenError(f"another magcal push sends the files of {folder}") from error
        yield


def _read_receipts(path: Path, destination: Destination) -> dict[str, str]:
    """Return session by digest; a last line that a power cut left torn is passed over: its file is sent again."""
    found: dict[str, str] = {}
    if not path.exists():
        return found
    whose = asdict(destination).items()
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            receipt = json.loads(line)
            if whose <= receipt.items():
                found[str(receipt["sha256"])] = str(receipt["session_id"])
        except (ValueError, KeyError, AttributeError):
            continue
    return found


def _is_being_written(path: Path) -> bool:
    """Return whether a process has the file open for writing, where the operating system and the file's owner tell.

    A lease to read is given only where nobody writes. Who opens the file meanwhile waits for its end, and this process
    gets SIGIO, which ends processes that do not ignore it.
    """
    if not hasattr(fcntl, "F_SETLEASE"):
        return False
    try:
        with path.open("rb") as file:
            fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _force_to_disk(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

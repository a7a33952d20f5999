"""The files of a station's folder: whose they are, whether they are whole, and how they are moved and never lost."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from magcal_client.errors import FolderTakenError

LOCK: Final = ".magcal-push.lock"
LONGEST_NAME: Final = 255
"""Bytes of a file's name."""


@dataclass(frozen=True)
class Look:
    """What tells two states of a file apart."""

    inode: int
    size: int
    changed_ns: int

    @classmethod
    def at(cls, path: Path) -> Look | None:
        """Return how a file is now, None where it is gone."""
        try:
            found = path.stat()
        except OSError:
            return None
        return cls(found.st_ino, found.st_size, found.st_mtime_ns)


def read_file(path: Path, *, follow_links: bool) -> bytes | None:
    """Return the bytes of a file, None where it went away; a link that has taken its place may be followed or not."""
    flags = os.O_RDONLY | os.O_NONBLOCK | (0 if follow_links else os.O_NOFOLLOW)
    try:
        number = os.open(path, flags)
    except FileNotFoundError:
        return None
    except OSError as error:
        if error.errno == errno.ELOOP:
            return None
        raise
    with os.fdopen(number, "rb") as file:
        return file.read()


def put_aside(path: Path, place: Path, digest: str) -> Path:
    """Move a file to the folder ``place``, on another disk too; one of its name that lies there keeps its own."""
    target = place / path.name
    if target.exists() and hashlib.sha256(target.read_bytes()).hexdigest() != digest:
        target = target.with_name(aside(path.name, digest))
    try:
        path.rename(target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        _carry(path, target, digest)
    for folder in (place, path.parent):
        force_to_disk(folder)
    return target


def is_too_long(name: str) -> bool:
    """Return whether a file cannot have this name."""
    return len(os.fsencode(name)) > LONGEST_NAME


def aside(name: str, digest: str) -> str:
    """Return the name of a file beside another of its name: the digest before as much of its end as there is room."""
    room = LONGEST_NAME - 13
    return f"{digest[:12]}-{os.fsencode(name)[-room:].decode('utf-8', 'ignore')}"


def _carry(path: Path, target: Path, digest: str) -> None:
    """Move a file to another disk: copied, on disk, under its name, and only then gone from where it was."""
    part = target.with_name(f".{digest}.part")
    with path.open("rb") as source, part.open("wb") as copy:
        shutil.copyfileobj(source, copy)
        copy.flush()
        os.fsync(copy.fileno())
    if hashlib.sha256(part.read_bytes()).hexdigest() != digest:
        part.unlink()
        raise OSError(errno.EIO, f"the copy on the other disk is not what was sent: {part}")
    shutil.copystat(path, part)
    part.replace(target)
    force_to_disk(target.parent)
    path.unlink()


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


def is_being_written(path: Path) -> bool:
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


def force_to_disk(folder: Path) -> None:
    """Return when the names of a folder are on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)

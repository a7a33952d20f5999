"""Power loss (F5): what a disk holds that keeps only what was synced, at the moment of each acknowledgement.

The server runs under strace. Its writes, syncs and renames are played again into folders that keep only what was synced
by then; the folder of each acknowledgement is opened as after a restart, and audited.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from faultsite import TRIALS, Site, prepare, upload

from app.access.caller import SYSTEM
from app.maintenance.audit import audit
from app.sessions.repository import SessionRepository
from app.settings import Settings
from app.storage.database import Database
from app.storage.open_store import open_store

UPLOADS = max(20, TRIALS)
CALLS = "openat,pwrite64,write,ftruncate,fsync,fdatasync,rename,unlink,sendto"
LINE = re.compile(r"(?P<task>\d+) +(?:<\.\.\. (?P<resumed>\w+) resumed>)?(?P<text>.*)")
CALL = re.compile(r"(?P<name>\w+)\((?P<rest>.*)\) += (?P<result>-?\d+)")
PLACE = re.compile(r"\d+<((?:\\x[0-9a-f]{2})*)>")
TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"')
ACKNOWLEDGED = re.compile(rb"HTTP/1\.1 201.*?location: /api/v1/sessions/([0-9a-f]{32})", re.DOTALL | re.IGNORECASE)


@dataclass
class Disk:
    """Files as the system shows them, and as the disk has them."""

    shown: dict[str, bytearray]
    kept: dict[str, bytes]
    names: dict[str, bytes | None] = field(default_factory=dict)
    """Names that were made, changed (to a file's kept bytes) or removed since their folder was synced."""

    def write(self, path: str, at: int, content: bytes) -> None:
        file = self.shown.setdefault(path, bytearray())
        file.extend(bytes(max(0, at + len(content) - len(file))))
        file[at : at + len(content)] = content

    def sync(self, path: str, shown: bytes | None) -> None:
        """Keep what a file showed when the sync began, or the names in a folder."""
        if shown is not None:
            self.kept[path] = shown
            return
        for name in [one for one in self.names if str(Path(one).parent) == path]:
            if self.names.pop(name) is None:
                self.kept.pop(name, None)

    def image(self, folder: Path, root: Path) -> None:
        """Write what the disk holds: kept bytes under kept names."""
        for path, content in self.kept.items():
            if path not in self.names and not path.endswith("-shm"):
                target = folder / Path(path).relative_to(root)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(content)


def calls(trace: Path) -> Iterator[tuple[str, str, str, bool]]:
    """Yield (task, name, text, whether it has ended) of every call: twice where others came between begin and end."""
    begun: dict[str, str] = {}
    for line in trace.read_text().splitlines():
        parts = LINE.fullmatch(line)
        if parts is None:
            continue
        task, text = parts["task"], parts["text"]
        if text.endswith("<unfinished ...>"):
            begun[task] = text.removesuffix("<unfinished ...>")
            yield task, text.partition("(")[0], begun[task], False
            continue
        whole = begun.pop(task, "") + text if parts["resumed"] else text
        if not parts["resumed"]:
            yield task, whole.partition("(")[0], whole, False
        yield task, whole.partition("(")[0], whole, True


def strings(text: str, form: re.Pattern[str] = TEXT) -> list[bytes]:
    return [bytes.fromhex(one.replace("\\x", "")) for one in form.findall(text)]


def images(trace: Path, disk: Disk, root: Path, folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield each acknowledged session with the folder that a power loss at that moment would leave."""
    syncing: dict[str, bytes | None] = {}
    for task, name, text, has_ended in calls(trace):
        path = next((one.decode() for one in strings(text, PLACE)), "")
        if name == "sendto" and not has_ended and (sent := ACKNOWLEDGED.search(b"".join(strings(text)))):
            session_id = sent[1].decode()
            image = folder / session_id
            disk.image(image, root)
            yield session_id, image
        elif name in {"fsync", "fdatasync"} and path.startswith(str(root)):
            if not has_ended:
                syncing[task] = bytes(disk.shown[path]) if path in disk.shown else None
            else:
                disk.sync(path, syncing.pop(task))
        elif has_ended and (done := CALL.match(text)) and int(done["result"]) >= 0:
            play(disk, name, text, path, root)


def play(disk: Disk, name: str, text: str, path: str, root: Path) -> None:
    """Let the system show what a call has done."""
    if name == "openat" and "O_CREAT" in text:
        made = strings(text, PLACE)[-1].decode()
        if made.startswith(str(root)) and (made not in disk.shown or "O_TRUNC" in text):
            disk.names.setdefault(made, b"")
            disk.shown[made] = bytearray()
    elif name == "rename":
        old, new = (one.decode() for one in strings(text))
        disk.shown[new] = disk.shown.pop(old)
        disk.kept[new] = disk.kept.pop(old, b"")
        disk.names.pop(old, None)
        disk.names[new] = b""
    elif name == "unlink":
        gone = strings(text)[0].decode()
        if disk.shown.pop(gone, None) is not None:
            disk.names[gone] = None
    elif name in {"write", "pwrite64", "ftruncate"} and path.startswith(str(root)):
        file = disk.shown.setdefault(path, bytearray())
        if name == "ftruncate":
            size = int(text.rpartition(", ")[2].partition(")")[0])
            del file[size:]
            file.extend(bytes(size - len(file)))
        else:
            at = int(text.rpartition(", ")[2].partition(")")[0]) if name == "pwrite64" else len(file)
            disk.write(path, at, strings(text)[0])


@pytest.mark.timeout(300 + 10 * (UPLOADS - 20))
@pytest.mark.parametrize("store", ["database", "folder"])
def test_what_is_acknowledged_is_on_the_disk_and_not_only_on_its_way(
    new_site: Callable[..., Site], tmp_path: Path, telemetry: bytes, store: str
):
    """Each upload is found after a power loss at the moment of its acknowledgement; none could be otherwise."""
    assert shutil.which("strace"), (
        "strace, which shows what was synced when, is not installed; `make system` installs it"
    )
    site, root = new_site(), tmp_path / "data"
    if store == "folder":
        site.environment["MAGCAL_STORE_URL"] = f"file://{root}/store"
    trace = tmp_path / "trace"
    server, url = site.serve(workers=0)
    with site.client(url) as api:
        prepare(api)
    server.terminate()
    assert server.wait(60) == 0
    before = {str(path): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    site.prefix = ["strace", "-f", "-y", "-xx", "-s", "10000000", "-o", str(trace), "-e", f"trace={CALLS}"]
    server, url = site.serve(workers=0)
    lines = telemetry.splitlines(keepends=True)
    with site.client(url) as api:
        sent = [upload(api, b"".join(lines[: 30 + number])) for number in range(UPLOADS)]
    assert [one.status_code for one in sent] == [201] * UPLOADS
    os.kill(int(Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()[0]), signal.SIGKILL)
    server.wait(60)
    disk = Disk({path: bytearray(content) for path, content in before.items()}, dict(before))
    seen = []
    for session_id, image in images(trace, disk, root, tmp_path / "images"):
        seen.append(session_id)
        url = f"file://{image}/store" if store == "folder" else None
        settings = Settings(data_dir=image, store_url=url)
        database = Database(settings)
        with database.read() as session:
            kept = SessionRepository(session, SYSTEM).get(session_id)
            assert kept.sha256 == sent[len(seen) - 1].json()["sha256"]
        found = audit(database, open_store(settings))
        assert (found.findings, found.sessions) == ((), len(seen))
        database.close()
    assert seen == [one.json()["id"] for one in sent]

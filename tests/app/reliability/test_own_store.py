"""A store belongs to its database, and a data folder too: whatever is put in their place is refused, and written to."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import pytest

from app.server import prepare
from app.settings import Settings
from app.storage.identity import MEMORY, WrongStoreError
from app.storage.object_store import FileStore
from tests.faults.stem import Stems

CSV = {"content-type": "text/csv"}
PASS = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"


@pytest.fixture
def magcal(stems: Stems, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """What runs a command of magcal in a process of its own, with ``settings`` and no others of magcal's."""
    folder = tmp_path_factory.mktemp("commands")

    def run(*words: str, **settings: str) -> subprocess.CompletedProcess[str]:
        with pytest.MonkeyPatch.context() as patch:
            for name in [name for name in os.environ if name.startswith("MAGCAL_")]:
                patch.delenv(name)
            return stems.run(*words, folder=folder, **{f"MAGCAL_{name.upper()}": one for name, one in settings.items()})

    return run


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return the one line in which a command says why it failed."""
    assert done.returncode == 1, done
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("magcal: ")]
    assert len(lines) == 1, done.stderr
    return lines[0]


OPENED: list[httpx2.Client] = []


@pytest.fixture(autouse=True)
def no_client_left_open() -> Iterator[None]:
    yield
    while OPENED:
        OPENED.pop().close()


def filled(service) -> httpx2.Client:
    api = service.client()
    OPENED.append(api)
    api.post("/satellites", json={"id": "a"}).raise_for_status()
    api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    assert send(api, 0).status_code == 201
    return api


def send(api: httpx2.Client, number: int) -> httpx2.Response:
    content = PASS.replace("20000,1", f"20000,{number}")
    return api.post("/satellites/a/sessions?magnetometer=m", content=content, headers=CSV)


def readiness(service) -> tuple[int, dict[str, str]]:
    answer = httpx2.get(f"{service.url}/readyz", trust_env=False)
    return answer.status_code, answer.json()


@pytest.fixture
def outside(new_service: Callable[..., object], tmp_path: Path) -> tuple[object, Path]:
    """A service whose objects are in a folder outside of its database."""
    folder = tmp_path / "mounted"
    return new_service(store_url=f"file://{folder}"), folder


def test_an_empty_mount_point_under_a_running_service_takes_nothing(outside):
    service, folder = outside
    api = filled(service)
    folder.rename(folder.with_name("unmounted"))
    folder.mkdir()
    answer = send(api, 1)
    assert (answer.status_code, answer.json()["code"]) == (503, "unavailable")
    assert readiness(service) == (
        503,
        {
            "status": "failing",
            "database": "ok",
            "store": "failing",
            "queue": "ok",
            "disk": "ok",
            "kernels": "ok",
            "sources": "ok",
        },
    )
    assert list(folder.rglob("*")) == []
    folder.rmdir()
    folder.with_name("unmounted").rename(folder)
    assert send(api, 1).status_code == 201
    assert readiness(service)[0] == 200


@pytest.mark.parametrize("mistake", ["empty", "missing", "unset", "another"])
def test_a_start_with_another_store_than_the_database_s_own_is_refused(outside, tmp_path, mistake):
    service, _ = outside
    filled(service).close()
    other = tmp_path / "other"
    if mistake == "empty":
        other.mkdir()
    if mistake == "another":
        prepare(Settings(data_dir=tmp_path / "second", store_url=f"file://{other}", min_free_mb=0))
    settings = service.settings.model_copy(update={"store_url": None if mistake == "unset" else f"file://{other}"})
    with pytest.raises(WrongStoreError):
        prepare(settings)
    assert mistake == "another" or not other.exists() or list(other.iterdir()) == []
    assert prepare(service.settings) is None


def test_a_fresh_database_over_the_store_of_another_gets_no_admin_key(outside, tmp_path):
    """A failover to an empty database: its folder is new too, and only the store knows."""
    service, folder = outside
    filled(service).close()
    fresh = Settings(data_dir=tmp_path / "fresh", store_url=f"file://{folder}", min_free_mb=0)
    with pytest.raises(WrongStoreError, match="belongs to"):
        prepare(fresh)


@pytest.mark.postgres
def test_a_fresh_postgresql_in_place_of_the_service_s_own_is_refused(new_service, postgres_url, postgres_server):
    import psycopg
    from sqlalchemy import make_url

    service = new_service(database_url=postgres_url)
    filled(service).close()
    name = make_url(postgres_url).database
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())
        connection.execute(f"CREATE DATABASE {name}".encode())
    with service.client() as api:
        assert api.get("/satellites").status_code == 503
    assert readiness(service)[1]["database"] == "failing"
    with pytest.raises(WrongStoreError, match="new, but its data folder"):
        prepare(service.settings)
    with psycopg.connect(postgres_url) as connection:
        assert connection.execute("SELECT to_regclass('api_key')").fetchone() == (None,)


@pytest.mark.parametrize("harm", ["removed", "replaced"])
def test_a_database_file_that_is_not_the_one_that_was_opened_takes_nothing(new_service, harm):
    service = new_service()
    api = filled(service)
    database = service.settings.data_dir / "magcal.db"
    if harm == "replaced":
        shutil.copy(database, database.with_name("copy.db"))
        database.with_name("copy.db").rename(database)
    else:
        database.unlink()
    assert send(api, 1).status_code == 503
    assert readiness(service)[1]["database"] == "failing"


def test_a_database_file_that_is_gone_is_not_made_anew(new_service, tmp_path, magcal):
    service = new_service()
    filled(service).close()
    shutil.copytree(service.settings.data_dir, tmp_path / "left")
    for path in (tmp_path / "left").glob("magcal.db*"):
        path.unlink()
    for words in (("serve", "--port", "0"), ("worker",), ("keys", "list"), ("db", "upgrade")):
        assert "is gone" in one_line(magcal(*words, data_dir=str(tmp_path / "left")))
    assert not (tmp_path / "left" / "magcal.db").exists()


def test_a_damaged_database_file_is_not_ready(new_service):
    service = new_service()
    api = filled(service)
    for number in range(1, 60):
        send(api, number)
    assert readiness(service)[0] == 200
    path = service.settings.data_dir / "magcal.db"
    with service.database.engine.connect() as connection:
        connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
    size = path.stat().st_size
    with path.open("r+b") as file:
        for page in range(3, size // 4096 - 1, 2):
            file.seek(page * 4096)
            file.write(os.urandom(4096))
    assert readiness(service) == (
        503,
        {
            "status": "failing",
            "database": "failing",
            "store": "ok",
            "queue": "ok",
            "disk": "ok",
            "kernels": "ok",
            "sources": "ok",
        },
    )


@pytest.mark.parametrize("words", [("keys", "create", "--scopes", "admin"), ("keys", "list"), ("db", "audit")])
def test_commands_in_the_wrong_folder_make_no_database(tmp_path, words, magcal):
    assert "there is no database" in one_line(magcal(*words, data_dir=str(tmp_path / "nowhere")))
    assert not (tmp_path / "nowhere").exists()


def test_a_new_key_comes_with_the_name_of_its_database(tmp_path, magcal):
    assert magcal("db", "upgrade", data_dir=str(tmp_path)).returncode == 0
    made = magcal("keys", "create", "--scopes", "read", data_dir=str(tmp_path))
    assert made.stdout.startswith("mgc_")
    assert f"database: sqlite:///{tmp_path}/magcal.db" in made.stderr


def test_a_folder_that_is_not_named_from_the_root_is_refused(tmp_path, magcal):
    for url in ("file://relative", "file:relative", "relative/path", "s3//typo", "nonsense://x"):
        line = one_line(magcal("serve", "--port", "0", data_dir=str(tmp_path / "d"), store_url=url))
        assert "MAGCAL_STORE_URL" in line
    assert not (tmp_path / "d" / "magcal.db").exists()


def test_a_store_from_before_markers_is_taken_where_it_has_the_telemetry(outside):
    """An upgrade: neither folder nor store has a marker yet; an empty store in its place is refused all the same."""
    service, folder = outside
    filled(service).close()
    (service.settings.data_dir / MEMORY).unlink()
    (folder / "magcal-store.json").unlink()
    with service.database.write() as session:
        session.connection().exec_driver_sql("DELETE FROM service_identity")
    (folder / "raw").rename(folder / "hidden")
    with pytest.raises(WrongStoreError, match="newest telemetry"):
        prepare(service.settings)
    (folder / "hidden").rename(folder / "raw")
    assert prepare(service.settings) is None
    assert json.loads((folder / "magcal-store.json").read_text()).keys() == {"database"}


def test_what_was_moved_on_purpose_is_adopted(outside, tmp_path, magcal):
    service, folder = outside
    filled(service).close()
    shutil.copytree(folder, tmp_path / "moved", ignore=shutil.ignore_patterns("magcal-store.json"))
    there = {"data_dir": str(service.settings.data_dir), "store_url": f"file://{tmp_path}/moved"}
    assert "magcal db adopt" in one_line(magcal("db", "audit", **there))
    assert magcal("db", "adopt", **there).returncode == 0
    assert magcal("db", "audit", **there).returncode == 1
    assert "belong together now" in magcal("db", "adopt", "--apply", **there).stdout
    assert magcal("db", "audit", **there).returncode == 0


def test_a_kill_while_a_database_is_given_its_id_is_gone_on_from(outside, tmp_path, monkeypatch):
    """The marker is written, the row is not: the next start uses the same id."""
    settings = Settings(data_dir=tmp_path / "new", store_url=f"file://{tmp_path}/new-store", min_free_mb=0)

    class KilledError(Exception):
        pass

    mark = FileStore.mark

    def kill(store: FileStore, database_id: str) -> None:
        mark(store, database_id)
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(FileStore, "mark", kill)
        with pytest.raises(KilledError):
            prepare(settings)
    assert prepare(settings) is not None


def test_a_wrong_setting_is_one_line_with_its_variable(tmp_path, magcal):
    for name, value in (("port", "abc"), ("max_upload_mb", "-1"), ("log_level", "loud")):
        line = one_line(magcal("serve", data_dir=str(tmp_path / "d"), **{name: value}))
        assert f"MAGCAL_{name.upper()}" in line
    assert not (tmp_path / "d").exists()


def test_a_taken_port_is_found_before_a_database_is_made(tmp_path, magcal):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        line = one_line(magcal("serve", "--port", str(taken.getsockname()[1]), data_dir=str(tmp_path / "d")))
    assert "MAGCAL_PORT" in line
    assert not (tmp_path / "d").exists()

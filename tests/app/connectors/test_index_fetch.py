"""`magcal indices fetch` against publishers on loopback, with the files as they publish them."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from sqlalchemy import select, update

from app.cli.main import magcal
from app.connectors.indices.fetch import IndexFetch
from app.connectors.indices.kyoto_dst import KyotoDst
from app.connectors.orbits.watch import stopped_sources
from app.connectors.tables import ConnectorMark
from app.indices.tables import IndexFile
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade

FILES = Path(__file__).resolve().parents[2] / "data" / "field"
LONG_AGO = datetime(2026, 1, 1, tzinfo=UTC)


def settings_of(folder: Path, url: str = "http://127.0.0.1:9") -> Settings:
    return Settings(data_dir=folder, gfz_url=url, kyoto_url=url, min_free_mb=0)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(settings_of(tmp_path))
    upgrade(opened, settings_of(tmp_path))
    yield opened
    opened.close()


def kept(database: Database) -> list[tuple[str, str]]:
    with database.read() as session:
        return [(row.name, row.format) for row in session.scalars(select(IndexFile).order_by(IndexFile.created_at))]


def states(database: Database, settings: Settings, source: str, since: datetime = LONG_AGO) -> list[str]:
    return [one.state for one in IndexFetch(database, settings, source).run(since)]


def let_time_pass(database: Database, hours: float) -> None:
    with database.write() as session:
        session.execute(update(ConnectorMark).values(updated_at=utc_now() - timedelta(hours=hours)))


def test_kp_comes_as_gfz_publishes_it_and_is_asked_for_once_in_six_hours(database, tmp_path, serve):
    fake = serve(lambda asked: (200, {}, (FILES / "kp_2024-05.txt").read_bytes()))
    settings = settings_of(tmp_path, fake.url)
    assert states(database, settings, "gfz-kp") == ["new"]
    assert [one.path for one in fake.asked] == ["/app/files/Kp_ap_since_1932.txt"]
    assert kept(database) == [("Kp", "gfz-kp")]
    for _ in range(10):  # as ten starts would
        assert states(database, settings, "gfz-kp") == ["not yet"]
    assert len(fake.asked) == 1
    let_time_pass(database, 6.1)
    assert states(database, settings, "gfz-kp") == ["known"]
    assert states(database, settings, "gfz-kp", utc_now() - timedelta(days=3)) == ["known"]
    assert fake.asked[-1].path == "/app/files/Kp_ap_nowcast.txt"


def test_dst_comes_month_by_month_and_a_final_month_is_not_asked_for_again(database, tmp_path, serve):
    fake = serve(lambda asked: (200, {}, (FILES / "dst_2024-05.txt").read_bytes()))
    settings = settings_of(tmp_path, fake.url)
    since = utc_now() - timedelta(days=150)
    first = states(database, settings, "kyoto-dst", since)
    assert set(first) == {"new", "known"}
    assert 5 <= len(first) <= 7
    month = f"{since:%y%m}"
    assert fake.asked[0].path == f"/dst_realtime/{since:%Y%m}/dst{month}.for.request"
    let_time_pass(database, 7.0)
    again = states(database, settings, "kyoto-dst", since)
    assert again[0] == "final"
    assert again[-1] == "known"


def test_months_go_over_the_end_of_a_year():
    parts = KyotoDst().parts(settings_of(Path()), datetime(2025, 11, 30, tzinfo=UTC), datetime(2026, 2, 1, tzinfo=UTC))
    assert [one.name for one in parts] == ["2025-11", "2025-12", "2026-01", "2026-02"]


def test_any_answer_but_200_stops_the_source_until_a_person_starts_it(database, tmp_path, serve):
    fake = serve(lambda asked: (403, {}, b"go away"))
    settings = settings_of(tmp_path, fake.url)
    since = utc_now() - timedelta(days=100)
    assert states(database, settings, "kyoto-dst", since) == ["failed"]
    let_time_pass(database, 100.0)
    assert states(database, settings, "kyoto-dst", since) == []
    assert len(fake.asked) == 1
    assert "403" in stopped_sources(database)[0]
    fetching = IndexFetch(database, settings, "kyoto-dst")
    assert (fetching.start_again(), fetching.start_again()) == (True, False)
    assert states(database, settings, "kyoto-dst", since) == ["failed"]


@pytest.mark.parametrize("answer", [b"<!DOCTYPE html><html>", b"", b"nothing of the kind"])
def test_what_is_no_index_is_not_kept_and_stops_nothing(database, tmp_path, serve, answer):
    fake = serve(lambda asked: (200, {}, answer))
    settings = settings_of(tmp_path, fake.url)
    assert states(database, settings, "gfz-kp") == ["failed"]
    assert (kept(database), stopped_sources(database)) == ([], [])


def test_the_index_of_another_kind_is_not_kept(database, tmp_path, serve):
    fake = serve(lambda asked: (200, {}, (FILES / "dst_2024-05.txt").read_bytes()))
    assert states(database, settings_of(tmp_path, fake.url), "gfz-kp") == ["failed"]
    assert kept(database) == []


def test_the_command_says_what_became_of_each_file(tmp_path, serve, monkeypatch):
    fake = serve(lambda asked: (200, {}, (FILES / "kp_2024-05.txt").read_bytes()))
    for name, value in {"DATA_DIR": str(tmp_path), "GFZ_URL": fake.url, "MIN_FREE_MB": "0"}.items():
        monkeypatch.setenv(f"MAGCAL_{name}", value)
    assert CliRunner().invoke(magcal, ["db", "upgrade"]).exit_code == 0
    done = CliRunner().invoke(magcal, ["indices", "fetch", "gfz-kp", "--since", "2026-01-01"])
    assert (done.exit_code, done.stdout) == (0, "Kp_ap_since_1932.txt: new\n")
    wrong = CliRunner().invoke(magcal, ["indices", "fetch", "gfz-kp", "--since", "tomorrow"])
    assert wrong.exit_code == 2
    assert "may be asked again" not in CliRunner().invoke(magcal, ["indices", "start", "gfz-kp"]).stdout

"""`magcal pull` against archives on loopback: everything comes, nothing twice, also over kills at every page."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import delete, select

from app.access.caller import SYSTEM
from app.connectors.errors import SourceAnswerError, SourceContentError
from app.connectors.tables import ConnectorMark, ConnectorSeen
from app.connectors.telemetry.contract import PullOptionError, Wanted, instant
from app.connectors.telemetry.pull import Pull
from app.connectors.telemetry.registry import ARCHIVES
from app.connectors.telemetry.satnogs import SatNogs
from app.errors import ConflictError
from app.jobs.engines.embedded import EmbeddedQueue
from app.maintenance.satellite_removal import holdings_of, remove_satellite
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade
from app.storage.open_store import open_store
from app.uploads.ingest import Ingest
from tests.faults.stem import Stems

BEGIN = datetime(2026, 11, 1, tzinfo=UTC)
MAP = {"bx": "/MAG/x", "by": "/MAG/y", "bz": "/MAG/z"}


def reading(number: int) -> tuple[float, float, float]:
    """Return three readings by which a row is known: the first is its number."""
    return 20_000.0 + number, 1.0 + number % 97, 2.0 + number % 89


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, max_bad_samples=1.0)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database(settings)
    upgrade(opened, settings)
    with opened.write() as session:
        session.add(Satellite(id="sat", norad_id="99999", created_at=utc_now()))
        session.flush()
        session.add(Magnetometer(satellite_id="sat", id="mgm", unit="nT", created_at=utc_now()))
    yield opened
    opened.close()


class Pulls:
    """One `magcal pull` after the other, each of which may be killed."""

    def __init__(self, stems: Stems, folder: Path) -> None:
        self._environment = os.environ | {"MAGCAL_DATA_DIR": str(folder), "MAGCAL_MAX_BAD_SAMPLES": "1"}
        self._stem, self._folder = stems.of(self._environment), folder

    def kill(self) -> None:
        self._process.kill()

    def statuses(self, url: str, most: int, kind: str = "yamcs") -> list[int]:
        """Return how each pull from the archive at ``url`` ended, up to the first that was not killed."""
        words = [
            "pull", kind, "--base-url", url, "--satellite", "sat", "--magnetometer", "mgm", "--instance", "sim",
            "--columns", json.dumps(MAP), "--since", BEGIN.isoformat(), "--once",
        ]  # fmt: skip
        found = []
        while len(found) < most and (not found or found[-1] == -9):
            self._process = self._stem.fork(words, self._environment, self._folder / "stderr", self._folder / "stdout")
            found.append(self._process.wait(120.0))
        return found


@pytest.fixture
def pulls(stems: Stems, tmp_path: Path) -> Pulls:
    return Pulls(stems, tmp_path)


def pull_of(database: Database, settings: Settings, kind: str, wanted: Wanted, archive: object = None) -> Pull:
    ingest = Ingest(database, open_store(settings), EmbeddedQueue(), settings)
    return Pull(
        database, settings, ingest, archive=(kind, archive or ARCHIVES[kind]), satellite_id="sat",
        magnetometer_id="mgm", wanted=wanted,
    )  # fmt: skip


def numbers(database: Database, settings: Settings) -> list[int]:
    """Return the number of every row that is kept, in time order of each session."""
    found: list[int] = []
    with database.read() as session:
        sessions = SessionRepository(session, SYSTEM)
        for session_id in session.scalars(select(TelemetrySession.id).order_by(TelemetrySession.id)):
            samples = samples_of(sessions.columns(session_id, open_store(settings)))
            found += (samples.h_nt[:, 0] - 20_000.0).round().astype(int).tolist()
    return found


def yamcs(rows: int, step_s: float):
    """Answer ``exportParameterValues`` as Yamcs does: a table with tabs, start <= t < stop."""

    def answer(asked):
        if asked.path != "/api/archive/sim:exportParameterValues":
            return 404, {}, b""
        names = asked.query["parameters"].split(",")
        start, stop = (datetime.fromisoformat(asked.query[name]) for name in ("start", "stop"))
        lines = ["\t".join(["Time", *(name.rpartition("/")[2] for name in names)])]
        first = max(0, int(np.ceil((start - BEGIN).total_seconds() / step_s)))
        for number in range(first, rows):
            time = BEGIN + timedelta(seconds=number * step_s)
            if time >= stop:
                break
            cells = (f"{one}" for one in reading(number))
            lines.append("\t".join([time.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z", *cells]))
        return 200, {"content-type": "text/csv"}, ("\n".join(lines) + "\n").encode()

    return answer


def test_ten_thousand_rows_over_five_pages_killed_at_each_page_are_all_there_and_none_twice(
    database, settings, serve, pulls
):
    """Spans of 6 h with 2,000 rows each at the real command line, killed while each is answered, then once more."""
    step_s = 6 * 3600 / 2000
    whole = yamcs(10_000, step_s)
    asked_spans: list[str] = []

    def answer(asked):
        if asked.query["start"] not in asked_spans:
            asked_spans.append(asked.query["start"])
            if len(asked_spans) <= 6 and len(whole(asked)[2]) > 100:
                pulls.kill()
        return whole(asked)

    assert pulls.statuses(serve(answer).url, 9) == [-9, -9, -9, -9, -9, 0]
    assert sorted(numbers(database, settings)) == list(range(10_000))


def history(rows: int, step_s: float, page: int):
    """Answer as Yamcs' parameter archive does: one parameter, ``page`` values at the most, a token for what is left."""

    def answer(asked):
        name = asked.path.removeprefix("/api/archive/sim/parameters")
        if name not in MAP.values() or asked.query["order"] != "asc":
            return 404, {}, b'{"exception": {"type": "NotFoundException"}}'
        start, stop = (datetime.fromisoformat(asked.query[one]) for one in ("start", "stop"))
        first = int(asked.query.get("next", max(0, int(np.ceil((start - BEGIN).total_seconds() / step_s)))))
        last = min(rows, int(np.ceil((stop - BEGIN).total_seconds() / step_s)))
        end = min(last, first + min(page, int(asked.query["limit"])))
        axis = list(MAP.values()).index(name)
        values = [
            {
                "id": {"name": name},
                "engValue": {"type": "FLOAT", "floatValue": reading(number)[axis]},
                "generationTime": (BEGIN + timedelta(seconds=number * step_s)).isoformat()[:19] + ".000Z",
                "acquisitionStatus": "ACQUIRED",
            }
            for number in range(first, end)
        ]
        document = {"parameter": values} | ({"continuationToken": str(end)} if end < last else {})
        return 200, {"content-type": "application/json"}, json.dumps(document).encode()

    return answer


@pytest.mark.slow
def test_a_history_of_ten_thousand_rows_over_five_pages_is_all_there_after_a_kill_at_each(
    database, settings, serve, pulls
):
    """A server that has no export: each process dies as it asks for another page of the last parameter's."""
    whole = history(10_000, 1.0, 2_000)
    places: set[str] = set()

    def answer(asked):
        place = asked.query.get("next", asked.query.get("start", ""))
        if asked.path.endswith("/z") and place not in places and len(places) < 5:
            places.add(place)
            pulls.kill()
        return whole(asked)

    assert pulls.statuses(serve(answer).url, 9) == [-9, -9, -9, -9, -9, 0]
    assert sorted(numbers(database, settings)) == list(range(10_000))


def hapi_of(rows: int, step_s: float):
    """Answer as a HAPI server does, as far as its dataset reaches."""
    info = {
        "HAPI": "3.2", "status": {"code": 1200}, "startDate": BEGIN.isoformat(),
        "stopDate": (BEGIN + timedelta(seconds=rows * step_s)).isoformat(),
        "parameters": [{"name": "Time", "type": "isotime"}, *({"name": one, "type": "double"} for one in MAP.values())],
    }  # fmt: skip

    def answer(asked):
        if asked.path == "/info":
            return 200, {}, json.dumps(info).encode()
        first, last = (
            int(np.ceil((datetime.fromisoformat(asked.query[name]) - BEGIN).total_seconds() / step_s))
            for name in ("time.min", "time.max")
        )
        lines = [
            f"{(BEGIN + timedelta(seconds=n * step_s)).isoformat()},{','.join(map(str, reading(n)))}"
            for n in range(first, min(last, rows))
        ]
        return 200, {}, "\n".join([*lines, ""]).encode()

    return answer


def satnogs_of(rows: int, step_s: float):
    """Answer as SatNOGS DB does, 2,000 frames a page, the newest first."""

    def answer(asked):
        start = datetime.fromisoformat(asked.query.get("start", "2000-01-01T00:00:00Z"))
        first = max(0, int(np.ceil((start - BEGIN).total_seconds() / step_s)))
        top = int(asked.query.get("cursor", rows))
        own = range(top - 1, max(first, top - 2000) - 1, -1)
        results = [
            {"timestamp": (BEGIN + timedelta(seconds=n * step_s)).isoformat(),
             "decoded": dict(zip(MAP.values(), map(str, reading(n)), strict=True))}
            for n in own
        ]  # fmt: skip
        more = None
        if own and own[-1] > first:
            more = f"http://{asked.headers['host']}/api/telemetry/?cursor={own[-1]}"
            more += f"&start={asked.query['start']}" if "start" in asked.query else ""
        return 200, {}, json.dumps({"next": more, "results": results}).encode()

    return answer


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hapi", "satnogs"])
def test_ten_thousand_rows_of_other_archives_killed_at_each_of_five_pages_are_all_there(
    database, settings, serve, pulls, kind
):
    """At the real command line, each process killed while another page is on its way to it."""
    whole = {"hapi": hapi_of, "satnogs": satnogs_of}[kind](10_000, 6 * 3600 / 2000)
    places: set[str] = set()

    def answer(asked):
        place = asked.query.get("cursor") or asked.query.get("time.min") or asked.path
        if place not in places and not (kind == "hapi" and asked.path == "/info") and len(places) < 5:
            places.add(place)
            pulls.kill()
        return whole(asked)

    assert pulls.statuses(serve(answer).url, 9, kind) == [-9, -9, -9, -9, -9, 0]
    assert sorted(numbers(database, settings)) == list(range(10_000))


def test_a_history_is_asked_for_where_told_and_its_parameters_may_part(database, settings, serve):
    """y has no value at every seventh time, z is invalid at one: those cells are gaps; a loop of tokens is told."""
    whole = history(200, 10.0, 30)

    def answer(asked):
        status, headers, body = whole(asked)
        document = json.loads(body)
        if asked.path.endswith("/y"):
            document["parameter"] = [one for i, one in enumerate(document["parameter"]) if i % 7]
        if asked.path.endswith("/z") and "next" not in asked.query:
            document["parameter"][3]["acquisitionStatus"] = "INVALID"
        return status, headers, json.dumps(document).encode()

    fake = serve(answer)
    wanted = Wanted(fake.url, MAP, "sim", BEGIN, by_history=True)
    assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 200
    assert {one.path.rpartition("/")[0] for one in fake.asked} == {"/api/archive/sim/parameters/MAG"}
    assert sorted(numbers(database, settings)) == list(range(200))
    fake.answer = lambda _asked: (200, {}, b'{"parameter": [], "continuationToken": "again"}')
    with pytest.raises(SourceContentError, match="goes on with the page that it had"):
        list(pull_of(database, settings, "yamcs", wanted).run())
    fake.answer = lambda _asked: (404, {}, b"")
    with pytest.raises(SourceAnswerError, match="404"):
        list(pull_of(database, settings, "yamcs", Wanted(fake.url, MAP, "none", BEGIN)).run())


@pytest.mark.parametrize(
    ("text", "iso"),
    [
        ("2026-305T01:02:03.5Z", "2026-11-01T01:02:03.500000+00:00"),
        ("2026-305Z", "2026-11-01T00:00:00+00:00"),
        ("2026-11-01Z", "2026-11-01T00:00:00+00:00"),
        ("2026-11-01T02:00+02:00", "2026-11-01T00:00:00+00:00"),
        ("2026-11-01 01:02:03", "2026-11-01T01:02:03+00:00"),
    ],
)
def test_times_of_archives_are_read_in_every_form_that_hapi_allows(text: str, iso: str):
    assert instant(text).isoformat() == iso


def test_a_pull_goes_on_where_it_stopped_and_a_gap_is_passed(database, settings, serve):
    fake = serve(yamcs(100, 10.0))
    wanted = Wanted(fake.url, MAP, "sim", BEGIN)
    assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 100
    asked = len(fake.asked)
    assert asked < 60
    fake.answer = yamcs(100, 10.0)
    assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 0
    assert len(fake.asked) - asked <= 1
    assert sorted(numbers(database, settings)) == list(range(100))


def make_anew(database: Database) -> None:
    """Remove the satellite with all it has, and make one of the same name."""
    with database.write() as session:
        remove_satellite(session, SYSTEM, "sat", holdings_of(session, SYSTEM, "sat").confirmation("sat"))
    with database.write() as session:
        session.add(Satellite(id="sat", norad_id="99999", created_at=utc_now()))
        session.flush()
        session.add(Magnetometer(satellite_id="sat", id="mgm", unit="nT", created_at=utc_now()))


def test_a_satellite_that_is_made_anew_is_pulled_from_the_start(database, settings, serve):
    """The mark goes with the satellite; a pull that was under way ends instead of going on behind what is gone."""
    fake = serve(yamcs(5000, 10.0))
    wanted = Wanted(fake.url, MAP, "sim", BEGIN)
    assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 5000
    make_anew(database)
    pages = pull_of(database, settings, "yamcs", wanted).run()
    assert next(pages).rows == 2160
    make_anew(database)
    with pytest.raises(ConflictError, match="removed and made anew"):
        next(pages)
    assert numbers(database, settings) == []
    assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 5000
    assert sorted(numbers(database, settings)) == list(range(5000))
    with database.write() as session:
        remove_satellite(session, SYSTEM, "sat", holdings_of(session, SYSTEM, "sat").confirmation("sat"))
        assert session.scalars(select(ConnectorMark)).all() == []


class Frames:
    """SatNOGS DB: frames the newest first, a cursor, a token, and a throttle at every third request."""

    def __init__(self, count: int, page: int) -> None:
        self.count, self.page, self.requests = count, page, 0
        self.url = ""

    def __call__(self, asked):
        self.requests += 1
        if asked.headers.get("authorization") != "Token secret":
            return 401, {}, b""
        if self.requests % 3 == 0:
            return 429, {"retry-after": "7"}, b""
        start = datetime.fromisoformat(asked.query["start"]) if "start" in asked.query else BEGIN - timedelta(days=1)
        top = int(asked.query.get("cursor", self.count))
        own = [n for n in range(top - 1, max(-1, top - 1 - self.page), -1) if self.time(n) >= start]
        following = own[-1] if own and own[-1] > 0 and self.time(own[-1] - 1) >= start else None
        results = [
            {"norad_cat_id": 99999, "timestamp": self.time(n).strftime("%Y-%m-%dT%H:%M:%SZ"), "frame": "00",
             "decoded": json.dumps({"mag": dict(zip("xyz", reading(n), strict=True))})}
            for n in own
        ]  # fmt: skip
        link = None if following is None else f"{self.url}/api/telemetry/?cursor={following}&start={start.isoformat()}"
        link = None if link is None else link.replace("+", "%2B")
        return 200, {}, json.dumps({"next": link, "previous": None, "results": results}).encode()

    @staticmethod
    def time(number: int) -> datetime:
        return BEGIN + timedelta(seconds=10 * number)


def test_satnogs_is_walked_page_by_page_with_a_token_and_its_throttle(database, settings, serve):
    """500 frames of 100 a page, cut after each page; then 30 new ones, and only those."""
    frames = Frames(500, 100)
    fake = serve(frames)
    frames.url = fake.url
    waited: list[float] = []
    columns = {"bx": "mag.x", "by": "mag.y", "bz": "mag.z"}
    wanted = Wanted(fake.url, columns, None, None, "secret")
    for _ in range(10):
        pull = pull_of(database, settings, "satnogs", wanted, SatNogs(waited.append))
        pages = pull.run()
        first = next(pages, None)
        pages.close()  # as if killed behind the page
        if first is None or first.rows == 0:
            break
    assert sorted(numbers(database, settings)) == list(range(500))
    frames.count = 530
    kept = [one.rows for one in pull_of(database, settings, "satnogs", wanted, SatNogs(waited.append)).run()]
    assert sum(kept) == 30
    assert sorted(numbers(database, settings)) == list(range(530))
    assert 7.0 in waited
    with pytest.raises(SourceAnswerError, match="401"):
        list(pull_of(database, settings, "satnogs", Wanted(fake.url, columns, None, None, "wrong")).run())


def hapi(asked):
    """Answer as a HAPI server does: a time, a vector with a fill value, rows once a minute for 20 h."""
    info = {
        "HAPI": "3.2", "status": {"code": 1200, "message": "OK"},
        "startDate": "2026-11-01T00:00:00Z", "stopDate": "2026-11-01T20:00:00Z",
        "parameters": [
            {"name": "Timestamp", "type": "isotime", "length": 24, "units": "UTC", "fill": None},
            {"name": "B_VFM", "type": "double", "units": "nT", "size": [3], "fill": "-1e31"},
        ],
    }  # fmt: skip
    if asked.query["id"] != "MAG":
        return 404, {}, json.dumps({"status": {"code": 1406, "message": "unknown dataset id"}}).encode()
    if asked.path == "/hapi/info":
        return 200, {}, json.dumps(info).encode()
    begin, end = (datetime.fromisoformat(asked.query[name]) for name in ("time.min", "time.max"))
    lines = []
    for number in range(1200):
        time = BEGIN + timedelta(minutes=number)
        if begin <= time < end:
            values = (-1e31,) * 3 if number == 7 else reading(number)
            lines.append(f"{time:%Y-%m-%dT%H:%M:%S}.000Z,{','.join(map(repr, values))}\n")
    header = "".join(f"#{line}\n" for line in json.dumps(info | {"about": ['a "b', 1] * 400}, indent=1).splitlines())
    return 200, {}, (header + "".join(lines)).encode()


def test_hapi_is_read_as_far_as_it_reaches_and_fill_values_are_none(database, settings, serve):
    fake = serve(hapi)
    columns = {"bx": "B_VFM[0]", "by": "B_VFM[1]", "bz": "B_VFM[2]"}
    wanted = Wanted(f"{fake.url}/hapi", columns, "MAG")
    for _ in range(2):
        list(pull_of(database, settings, "hapi", wanted).run())
    assert sorted(numbers(database, settings)) == [n for n in range(1200) if n != 7]
    with pytest.raises(SourceContentError, match="has no B_NEC"):
        list(pull_of(database, settings, "hapi", Wanted(f"{fake.url}/hapi", MAP | {"bx": "B_NEC"}, "MAG")).run())
    with pytest.raises(SourceAnswerError, match="404"):
        list(pull_of(database, settings, "hapi", Wanted(f"{fake.url}/hapi", columns, "NONE")).run())


def test_what_comes_down_with_the_next_pass_is_pulled_once_it_has_settled(database, settings, serve):
    """A row a minute for ten hours; those of the last five come down after the first pull, which waits for six."""
    begin = utc_now().replace(microsecond=0) - timedelta(minutes=600)

    def archive(rows):
        def answer(asked):
            start, stop = (datetime.fromisoformat(asked.query[name]) for name in ("start", "stop"))
            times = [(number, begin + timedelta(minutes=number)) for number in range(rows)]
            lines = ["\t".join([time.isoformat(), *map(str, reading(n))]) for n, time in times if start <= time < stop]
            return 200, {}, "\n".join(["Time\tx\ty\tz", *lines, ""]).encode()

        return answer

    fake = serve(archive(300))
    wanted = Wanted(fake.url, MAP, "sim", begin, settle=timedelta(hours=6))
    list(pull_of(database, settings, "yamcs", wanted).run())
    assert 239 <= len(numbers(database, settings)) <= 245
    fake.answer = archive(600)
    list(pull_of(database, settings, "yamcs", replace(wanted, settle=timedelta())).run())
    found = sorted(numbers(database, settings))
    assert len(found) >= 599
    assert found == list(range(len(found)))


def test_frames_of_slow_stations_are_pulled_once_they_have_settled(database, settings, serve):
    """Every other frame comes a pull later than its younger neighbours; all are kept, each once."""
    now = utc_now().replace(microsecond=0)
    columns = {"bx": "x", "by": "y", "bz": "z"}

    def frames(numbers):
        results = [
            {"timestamp": (now - timedelta(minutes=number)).isoformat(),
             "decoded": dict(zip("xyz", reading(number), strict=True))}
            for number in numbers
        ]  # fmt: skip
        return lambda _asked: (200, {}, json.dumps({"next": None, "results": results}).encode())

    fake = serve(frames([*range(0, 60, 2), *range(60, 120)]))
    wanted = Wanted(fake.url, columns, settle=timedelta(hours=1))
    wait = SatNogs(lambda _s: None)
    assert sum(one.rows for one in pull_of(database, settings, "satnogs", wanted, wait).run()) == 60
    fake.answer = frames(range(120))
    hasty = replace(wanted, settle=timedelta())
    assert sum(one.rows for one in pull_of(database, settings, "satnogs", hasty, wait).run()) == 60
    assert sorted(numbers(database, settings)) == list(range(120))


def let_time_pass(database: Database, hours: float) -> None:
    """Let the last look back be so long ago."""
    with database.write() as session:
        for row in session.scalars(select(ConnectorMark)):
            row.looked_back_at = utc_now() - timedelta(hours=hours)


def late_yamcs(begin: datetime, known: set[int]):
    """Answer as Yamcs does: a row a minute from ``begin``, those of ``known``."""

    def answer(asked):
        start, stop = (datetime.fromisoformat(asked.query[name]) for name in ("start", "stop"))
        times = [(number, begin + timedelta(minutes=number)) for number in sorted(known)]
        lines = ["\t".join([time.isoformat(), *map(str, reading(n))]) for n, time in times if start <= time < stop]
        return 200, {}, "\n".join(["Time\tx\ty\tz", *lines, ""]).encode()

    return answer


def late_hapi(begin: datetime, known: set[int]):
    info = {
        "HAPI": "3.2", "status": {"code": 1200}, "startDate": begin.isoformat(), "stopDate": "2099-01-01T00:00:00Z",
        "parameters": [{"name": "Time", "type": "isotime"}, *({"name": one, "type": "double"} for one in MAP.values())],
    }  # fmt: skip

    def answer(asked):
        if asked.path == "/info":
            return 200, {}, json.dumps(info).encode()
        first, last = (datetime.fromisoformat(asked.query[name]) for name in ("time.min", "time.max"))
        times = [(number, begin + timedelta(minutes=number)) for number in sorted(known)]
        lines = [f"{time.isoformat()},{','.join(map(str, reading(n)))}" for n, time in times if first <= time < last]
        return 200, {}, "\n".join([*lines, ""]).encode()

    return answer


def late_satnogs(begin: datetime, known: set[int]):
    """Answer as SatNOGS DB does: the newest first, 100 frames a page."""

    def answer(asked):
        start = datetime.fromisoformat(asked.query.get("start", "2000-01-01T00:00:00Z"))
        before = int(asked.query.get("cursor", 10**9))
        own = [n for n in sorted(known, reverse=True) if n < before and begin + timedelta(minutes=n) >= start]
        results = [
            {"timestamp": (begin + timedelta(minutes=n)).isoformat(),
             "decoded": {name: str(value) for name, value in zip(MAP.values(), reading(n), strict=True)}}
            for n in own[:100]
        ]  # fmt: skip
        more = f"http://{asked.headers['host']}/api/telemetry/?cursor={own[99]}" if len(own) > 100 else None
        if more is not None and "start" in asked.query:
            more += "&start=" + asked.query["start"].replace("+", "%2B")
        return 200, {}, json.dumps({"next": more, "results": results}).encode()

    return answer


LATE = {
    "yamcs": (late_yamcs, ARCHIVES["yamcs"]),
    "hapi": (late_hapi, ARCHIVES["hapi"]),
    "satnogs": (late_satnogs, SatNogs(lambda _s: None)),
}


@pytest.mark.parametrize("kind", LATE)
def test_what_comes_late_is_pulled_by_default_and_nothing_twice(database, settings, serve, kind):
    """A row a minute for 20 hours; every third one, and an hour of recordings, come after their neighbours were pulled.

    Each look back may be cut behind any page. One that comes later than the pull looks back is left.
    """
    answer, archive = LATE[kind]
    begin = utc_now().replace(microsecond=0) - timedelta(hours=20)
    early = {n for n in range(1190) if n % 3 and not 600 <= n < 660}
    fake = serve(answer(begin, early))
    wanted = Wanted(fake.url, MAP, "sim", begin)

    def pull(cut: int | None = None, of: Wanted = wanted) -> int:
        pages, rows = pull_of(database, settings, kind, of, archive).run(), 0
        for number, page in enumerate(pages):
            rows += page.rows
            if number == cut:
                pages.close()  # as if killed behind the page
        return rows

    assert pull() == len(early)
    fake.answer = answer(begin, set(range(1190)))
    asked = len(fake.asked)
    assert pull() == 0
    assert len(fake.asked) - asked <= 2  # it has looked back just now
    let_time_pass(database, 4.0)
    for cut in (0, 1, 0):
        pull(cut)
    pull()
    assert sorted(numbers(database, settings)) == list(range(1190))
    for _ in range(3):
        let_time_pass(database, 4.0)
        assert pull() == 0
    fake.answer = answer(begin, set(range(-2, 1190)))
    let_time_pass(database, 4.0)
    assert pull(of=replace(wanted, look_back=timedelta(hours=1))) == 0
    assert sorted(numbers(database, settings)) == list(range(1190))


@pytest.mark.parametrize("kind", LATE)
def test_a_look_back_that_was_cut_and_taken_up_days_later_takes_nothing_twice(database, settings, serve, kind):
    """What it took is forgotten by then, so that nothing is asked for again that pulls had reached before."""
    answer, archive = LATE[kind]
    begin = utc_now().replace(microsecond=0) - timedelta(hours=20)
    fake = serve(answer(begin, set(range(600))))
    wanted = Wanted(fake.url, MAP, "sim", begin)
    list(pull_of(database, settings, kind, wanted, archive).run())
    let_time_pass(database, 4.0)
    fake.answer = answer(begin, set(range(900)))
    pages = pull_of(database, settings, kind, wanted, archive).run()
    next(pages)
    pages.close()
    short = replace(wanted, look_back=timedelta(minutes=1))  # as if days had gone by
    fake.answer = answer(begin, set(range(1000)))
    for _ in range(3):
        let_time_pass(database, 4.0)
        list(pull_of(database, settings, kind, short, archive).run())
    found = numbers(database, settings)
    assert len(found) == len(set(found))
    # Marks of Yamcs and HAPI stand at the time of the pull: what comes behind them later than it looks back is left.
    assert kind != "satnogs" or sorted(found) == list(range(1000))


def test_a_row_that_lacked_a_value_comes_again_once_it_is_whole(database, settings, serve):
    """z of one row arrives an hour later than x and y; a late row that never is whole holds nothing up."""
    begin = utc_now().replace(microsecond=0) - timedelta(hours=5)

    def answer(missing):
        def told(asked):
            status, headers, body = late_yamcs(begin, set(range(240)))(asked)
            lines = body.decode().splitlines()
            cut = [line.rpartition("\t")[0] + "\t" if line.split("\t")[1] in missing else line for line in lines]
            return status, headers, "\n".join([*cut, ""]).encode()

        return told

    fake = serve(answer({"20100.0", "20101.0"}))
    wanted = Wanted(fake.url, MAP, "sim", begin)
    list(pull_of(database, settings, "yamcs", wanted).run())
    for missing, rows in (({"20101.0"}, 1), ({"20101.0"}, 0)):
        fake.answer = answer(missing)
        let_time_pass(database, 4.0)
        assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == rows


def test_a_mark_of_before_looking_back_sends_nothing_again(database, settings, serve):
    """A pull of a version that remembered nothing: what is before now is its own, and later rows are remembered."""
    begin = utc_now().replace(microsecond=0) - timedelta(hours=20)
    fake = serve(late_yamcs(begin, set(range(900))))
    wanted = Wanted(fake.url, MAP, "sim", begin)
    list(pull_of(database, settings, "yamcs", wanted).run())
    with database.write() as session:
        for row in session.scalars(select(ConnectorMark)):
            row.remembers_from = row.looked_back_at = None
        session.execute(delete(ConnectorSeen))
    for _ in range(2):
        let_time_pass(database, 4.0)
        assert sum(one.rows for one in pull_of(database, settings, "yamcs", wanted).run()) == 0


def test_an_archive_cannot_send_us_to_another_host(database, settings, serve):
    other = serve(lambda _asked: (200, {}, b'{"results": []}'))
    page = {"next": f"{other.url}/api/telemetry/?cursor=1", "results": [
        {"timestamp": "2026-11-01T00:00:00Z", "decoded": {"x": 20_000.0, "y": 1.0, "z": 2.0}},
    ]}  # fmt: skip
    fake = serve(lambda _asked: (200, {}, json.dumps(page).encode()))
    wanted = Wanted(fake.url, {"bx": "x", "by": "y", "bz": "z"})
    with pytest.raises(SourceContentError, match="another host"):
        list(pull_of(database, settings, "satnogs", wanted, SatNogs(lambda _s: None)).run())
    assert other.asked == []


def test_what_a_pull_must_be_told_is_said(database, settings):
    with pytest.raises(PullOptionError, match="bx, by, bz"):
        pull_of(database, settings, "yamcs", Wanted("http://127.0.0.1:9", {}, "sim", BEGIN))
    for kind, wanted in (
        ("yamcs", Wanted("http://127.0.0.1:9", MAP, None, BEGIN)),
        ("yamcs", Wanted("http://127.0.0.1:9", MAP, "sim")),
        ("hapi", Wanted("http://127.0.0.1:9", MAP)),
    ):
        with pytest.raises(PullOptionError):
            list(pull_of(database, settings, kind, wanted).run())

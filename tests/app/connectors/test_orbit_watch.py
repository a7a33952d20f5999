"""`magcal orbits watch` against catalogues on loopback: the manners are part of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from sqlalchemy import select, update

from app.access.caller import SYSTEM
from app.connectors.orbits.registry import ORBIT_SOURCES
from app.connectors.orbits.watch import OrbitWatch, start_again, stopped, stopped_sources
from app.connectors.tables import ConnectorRequest
from app.errors import UnavailableError
from app.maintenance.satellite_removal import holdings_of, remove_satellite
from app.orbits.tables import OrbitRow
from app.outbox.tables import OutboxEntry
from app.satellites.tables import Magnetometer, Satellite
from app.sessions.tables import TelemetrySession
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.exclusive import Exclusive
from app.storage.migration import upgrade

TLE = (
    "1 40014U 14033AL  26330.50000000  .00001000  00000-0  10000-3 0  999",
    "2 40014  97.9000 100.0000 0010000  50.0000 310.0000 14.90000000 1234",
)


def summed(line: str) -> str:
    """Return a line of a TLE with its checksum."""
    return line + str(sum(int(c) if c.isdigit() else c == "-" for c in line) % 10)


def omm(norad_id: int, cospar_id: str = "2026-001A", epoch: str = "2026-11-29T10:00:00.123456") -> dict[str, object]:
    """Return elements as CelesTrak and Space-Track write them in JSON."""
    return {
        "OBJECT_NAME": "X", "OBJECT_ID": cospar_id, "EPOCH": epoch, "MEAN_MOTION": 15.2, "ECCENTRICITY": 0.001,
        "INCLINATION": 97.5, "RA_OF_ASC_NODE": 10.0, "ARG_OF_PERICENTER": 20.0, "MEAN_ANOMALY": 30.0,
        "EPHEMERIS_TYPE": 0, "CLASSIFICATION_TYPE": "U", "NORAD_CAT_ID": norad_id, "ELEMENT_SET_NO": 999,
        "REV_AT_EPOCH": 1, "BSTAR": 1e-4, "MEAN_MOTION_DOT": 1e-5, "MEAN_MOTION_DDOT": 0,
    }  # fmt: skip


def celestrak(asked):
    """Answer as gp.php does: a list of elements; a line of text where there are none."""
    if asked.path != "/NORAD/elements/gp.php" or asked.query.get("FORMAT") != "json":
        return 404, {}, b"not here"
    number = int(asked.query["CATNR"])
    return (200, {}, b"No GP data found") if number == 404 else (200, {}, json.dumps([omm(number)]).encode())


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(Settings(data_dir=tmp_path))
    upgrade(opened, Settings(data_dir=tmp_path))
    yield opened
    opened.close()


def add(database: Database, **norad_ids: str) -> None:
    with database.write() as session:
        session.add_all(Satellite(id=name, norad_id=number, created_at=utc_now()) for name, number in norad_ids.items())


def orbits(database: Database) -> list[OrbitRow]:
    with database.read() as session:
        return list(session.scalars(select(OrbitRow).order_by(OrbitRow.satellite_id)))


def look(database: Database, settings: Settings, source: str = "celestrak") -> list[tuple[str, str]]:
    """Return what became of a round of a process that starts and ends with it."""
    watch = OrbitWatch(database, settings, source)
    found = watch.round()
    watch.release()
    return [(one.satellite_id, one.state) for one in found]


def hours_go_by(database: Database, hours: float) -> None:
    with database.write() as session:
        for row in session.scalars(select(ConnectorRequest)):
            row.asked_at -= timedelta(hours=hours)


def test_orbits_come_by_themselves_nine_digits_and_all(database, serve, tmp_path):
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url)
    add(database, a="25544", b="123456789", c="00404")
    assert look(database, settings) == [("a", "new"), ("b", "new"), ("c", "failed")]
    assert [one.query["CATNR"] for one in fake.asked] == ["25544", "123456789", "404"]
    assert [(row.satellite_id, row.details["norad_id"]) for row in orbits(database)] == [
        ("a", "25544"), ("b", "123456789"),
    ]  # fmt: skip
    with database.read() as session:
        assert stopped(session, "celestrak") is None


def test_ten_restarts_are_no_second_request_in_two_hours_and_less_is_refused(database, serve, tmp_path):
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url, orbit_every_h=2.0)
    add(database, a="25544")
    for _ in range(10):
        look(database, settings)
    assert len(fake.asked) == 1
    hours_go_by(database, 1.99)
    look(database, settings)
    assert len(fake.asked) == 1
    hours_go_by(database, 0.25)
    assert look(database, settings) == [("a", "known")]
    assert len(fake.asked) == 2
    with pytest.raises(ValueError, match="orbit_every_h"):
        Settings(orbit_every_h=1.9)
    assert Settings().orbit_every_h == 8.0


def test_a_kill_in_the_middle_of_a_request_is_no_reason_for_another(database, serve, tmp_path):
    """The process dies with the request on its way, at the real command line."""

    def never(asked):
        os.kill(process.pid, 9)
        return 200, {}, json.dumps([omm(25544)]).encode()

    fake = serve(never)
    add(database, a="25544")
    environment = os.environ | {"MAGCAL_DATA_DIR": str(tmp_path), "MAGCAL_CELESTRAK_URL": fake.url}
    command = [Path(sys.executable).with_name("magcal"), "orbits", "watch", "--once", "--source", "celestrak"]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.communicate()
    assert process.returncode == -9
    fake.answer = celestrak
    assert look(database, Settings(data_dir=tmp_path, celestrak_url=fake.url)) == [("a", "not yet")]
    assert len(fake.asked) == 1


@pytest.mark.parametrize("status", [301, 304, 401, 403, 404, 429, 500, 503])
def test_any_answer_but_200_stops_the_source_until_a_person_starts_it_again(database, serve, tmp_path, status):
    fake = serve(lambda _asked: (status, {"location": "/elsewhere"}, b""))
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url)
    add(database, a="25544", b="25545")
    assert look(database, settings) == [("a", "failed")]
    hours_go_by(database, 100.0)
    for _ in range(3):
        look(database, settings)
    assert len(fake.asked) == 1
    (why,) = stopped_sources(database)
    assert str(status) in why
    with database.read() as session:
        raised = session.scalars(select(OutboxEntry)).one()
        assert (raised.type, str(status) in raised.data["reason"]) == ("attention.raised", True)
    with database.write() as session:
        assert start_again(session, "celestrak")
        assert not start_again(session, "celestrak")
    fake.answer = celestrak
    assert look(database, settings) == [("a", "new"), ("b", "new")]
    with database.read() as session:
        assert [one.type for one in session.scalars(select(OutboxEntry).order_by(OutboxEntry.id))] == [
            "attention.raised", "attention.cleared",
        ]  # fmt: skip


def test_another_objects_orbit_a_page_and_nonsense_are_not_kept_and_stop_nothing(database, serve, tmp_path):
    answers = {
        "25544": json.dumps([omm(25545)]).encode(),
        "25545": b"<!DOCTYPE html><html>maintenance</html>",
        "25546": b"[{}]",
    }
    fake = serve(lambda asked: (200, {}, answers[asked.query["CATNR"]]))
    add(database, a="25544", b="25545", c="25546")
    watch = OrbitWatch(database, Settings(data_dir=tmp_path, celestrak_url=fake.url), "celestrak")
    found = {one.satellite_id: one.why or "" for one in watch.round()}
    watch.release()
    assert "another object" in found["a"]
    assert "HTML" in found["b"]
    assert "cannot be read" in found["c"]
    assert orbits(database) == []
    assert stopped_sources(database) == []


def remove(database: Database, name: str) -> None:
    with database.write() as session:
        confirmation = holdings_of(session, SYSTEM, name).confirmation(name)
        remove_satellite(session, SYSTEM, name, confirmation)


def test_a_satellite_that_is_removed_and_made_anew_is_no_reason_for_another_request(database, serve, tmp_path):
    """Ten times in one minute: one request; and none of a hundred and fifty in an hour is forgotten."""
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url)
    for _ in range(10):
        add(database, a="25544")
        look(database, settings)
        remove(database, "a")
    assert len(fake.asked) == 1
    with database.read() as session:
        (row,) = session.scalars(select(ConnectorRequest))
        assert (row.satellite_id, row.catalogue_number) == (None, "25544")
    secret = tmp_path / "password"
    secret.write_text("secret")
    track = serve(space_track(["2026-11-29T12:00:00"], []))
    settings = Settings(
        data_dir=tmp_path, space_track_url=track.url, space_track_user="me", space_track_password_file=secret
    )
    add(database, **{f"s{n:02d}": str(30000 + n) for n in range(15)})
    look(database, settings, "space-track")
    for n in range(15):
        remove(database, f"s{n:02d}")
    add(database, **{f"t{n:02d}": str(40000 + n) for n in range(3)})
    assert [state for _, state in look(database, settings, "space-track")] == ["not yet"] * 3
    assert len(track.asked) == 30


def test_satellites_of_one_catalogue_number_share_one_request(database, serve, tmp_path):
    """One spacecraft that is kept twice, as a flight model and for rehearsals: both get the orbit."""
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url)
    add(database, flight="25544", rehearsal="0025544", other="25545")
    assert look(database, settings) == [("flight", "new"), ("rehearsal", "new"), ("other", "new")]
    assert look(database, settings) == [("flight", "not yet"), ("rehearsal", "not yet"), ("other", "not yet")]
    assert [one.query["CATNR"] for one in fake.asked] == ["25544", "25545"]


def test_requests_that_a_version_without_catalogue_numbers_wrote_count(database, serve, tmp_path):
    fake = serve(celestrak)
    add(database, a="25544")
    with database.write() as session:
        session.add(ConnectorRequest(id=new_id(), source="celestrak", satellite_id="a", asked_at=utc_now()))
    assert look(database, Settings(data_dir=tmp_path, celestrak_url=fake.url)) == [("a", "not yet")]
    assert fake.asked == []


@pytest.mark.parametrize(
    ("cospar_id", "state"),
    [("2026-001A", "new"), ("26001A", "new"), ("2026-1A", "new"), ("2026-001B", "failed")],
)
def test_whose_orbit_it_is_is_told_as_for_uploads(database, serve, tmp_path, cospar_id, state):
    """The number is right, and the designator is compared too, whatever its form."""
    fake = serve(celestrak)
    with database.write() as session:
        session.add(Satellite(id="a", norad_id="25544", cospar_id=cospar_id, created_at=utc_now()))
    assert look(database, Settings(data_dir=tmp_path, celestrak_url=fake.url)) == [("a", state)]


def test_one_process_asks_at_a_time(database, serve, tmp_path):
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, celestrak_url=fake.url)
    add(database, a="25544")
    other = Exclusive(database, settings, "orbits-celestrak")
    assert other.acquire()
    assert look(database, settings) == []
    other.release()
    assert look(database, settings) == [("a", "new")]


@pytest.mark.postgres
def test_one_process_of_a_cluster_asks_at_a_time(tmp_path, serve, postgres_url):
    fake = serve(celestrak)
    settings = Settings(data_dir=tmp_path, database_url=postgres_url, celestrak_url=fake.url)
    first, second = Database(settings), Database(settings)
    upgrade(first, settings)
    add(first, a="25544")
    holder = Exclusive(second, settings, "orbits-celestrak")
    assert holder.acquire()
    assert look(first, settings) == []
    second.close()
    holder.release()
    assert look(first, settings) == [("a", "new")]
    first.close()


def test_space_track_logs_in_and_keeps_to_its_limits(database, serve, tmp_path):
    """Thirty requests a minute, two a satellite: of 20 satellites, 15 are asked for now and the rest a minute later."""

    def answer(asked):
        if asked.path == "/ajaxauth/login":
            is_known = asked.body == b"identity=me%40example.org&password=secret"
            return (200, {"set-cookie": "chocolatechip=1; Path=/"}, b'""') if is_known else (401, {}, b"")
        if asked.headers.get("cookie") != "chocolatechip=1":
            return 401, {}, b""
        number = int(asked.path.split("/NORAD_CAT_ID/")[1].split("/")[0])
        return 200, {}, json.dumps([{name: str(value) for name, value in omm(number).items()}]).encode()

    fake = serve(answer)
    secret = tmp_path / "password"
    secret.write_text("secret\n")
    settings = Settings(
        data_dir=tmp_path, space_track_url=fake.url, space_track_user="me@example.org", space_track_password_file=secret
    )
    add(database, **{f"s{n:02d}": str(30000 + n) for n in range(20)})
    states = [state for _, state in look(database, settings, "space-track")]
    assert states == ["new"] * 15 + ["not yet"] * 5
    assert len(fake.asked) == 30
    with database.write() as session:
        session.execute(update(ConnectorRequest).values(asked_at=utc_now() - timedelta(seconds=61)))
    assert [state for _, state in look(database, settings, "space-track")].count("new") == 5
    secret.write_text("wrong")
    hours_go_by(database, 10.0)
    look(database, settings, "space-track")
    assert "401" in stopped_sources(database)[0]


@pytest.fixture
def logged_in(tmp_path):
    """Return settings of a login at an address."""
    secret = tmp_path / "password"
    secret.write_text("secret\n")

    def settings(url: str) -> Settings:
        return Settings(data_dir=tmp_path, space_track_url=url, space_track_user="me", space_track_password_file=secret)

    return settings


LIMIT_PAGE = b"<html>You've violated your query rate limit. Please refer to our Acceptable Use guidelines</html>"


@pytest.mark.parametrize("status", [302, 401, 429, 500])
def test_what_space_tracks_package_would_repeat_or_follow_ends_with_the_answer(database, serve, logged_in, status):
    """By itself it waits a minute and asks again at the limit's 500, logs in anew at 401, and follows redirects."""
    other = serve(lambda _asked: (200, {}, json.dumps([omm(25544)]).encode()))

    def answer(asked):
        if asked.path == "/ajaxauth/login":
            return 200, {"set-cookie": "chocolatechip=1; Path=/"}, b'""'
        return status, {"location": f"{other.url}/elsewhere"}, LIMIT_PAGE

    fake = serve(answer)
    add(database, a="25544", b="25545")
    assert look(database, logged_in(fake.url), "space-track") == [("a", "failed")]
    hours_go_by(database, 100.0)
    look(database, logged_in(fake.url), "space-track")
    assert [one.method for one in fake.asked] == ["POST", "GET"]
    assert other.asked == []
    assert str(status) in stopped_sources(database)[0]


def test_space_track_is_asked_by_its_package_with_a_login_and_one_query(database, serve, logged_in):
    """Neither the names of predicates nor a logout cost a request; the package writes the address."""
    fake = serve(space_track(["2026-11-29T12:00:00"], []))
    add(database, a="123456789")
    assert look(database, logged_in(fake.url), "space-track") == [("a", "new")]
    assert [one.path for one in fake.asked] == [
        "/ajaxauth/login",
        "/basicspacedata/query/class/gp/format/json/NORAD_CAT_ID/123456789/orderby/EPOCH desc/limit/1",
    ]


@pytest.mark.parametrize("body", [b'{"Login": "Failed"}', b"<html>maintenance</html>"])
def test_a_login_that_fails_with_200_is_told_and_a_wrong_one_is_not_repeated(database, serve, logged_in, body):
    fake = serve(lambda _asked: (200, {}, body))
    add(database, a="25544")
    assert look(database, logged_in(fake.url), "space-track") == [("a", "failed")]
    assert len(fake.asked) == 1
    is_wrong = body.startswith(b"{")
    assert ["login failed" in why for why in stopped_sources(database)] == ([True] if is_wrong else [])


def test_without_its_package_space_track_is_refused_with_the_extra_that_brings_it(
    database, serve, logged_in, monkeypatch
):
    """Before a request is written down, so that it can be asked as soon as the package is there."""
    fake = serve(space_track(["2026-11-29T12:00:00"], []))
    add(database, a="25544")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "spacetrack", None)
        with pytest.raises(UnavailableError, match=r"install magcal-service\[space-track\]"):
            look(database, logged_in(fake.url), "space-track")
        assert look(database, logged_in(fake.url), "folder") == [("a", "failed")]
    assert look(database, logged_in(fake.url), "space-track") == [("a", "new")]


def test_satnogs_a_template_and_a_folder_are_read(database, serve, tmp_path):
    lines = [summed(line) for line in TLE]
    entry = {"tle0": "0 SAT", "tle1": lines[0], "tle2": lines[1], "tle_source": "x", "norad_cat_id": 40014}

    def answer(asked):
        if asked.path == "/api/tle/" and asked.query == {"norad_cat_id": "40014", "format": "json"}:
            return 200, {}, json.dumps([entry]).encode()
        if asked.path == "/orbits/40014.tle":
            return 200, {}, "\n".join(lines).encode()
        return 404, {}, b""

    fake = serve(answer)
    (tmp_path / "orbits").mkdir()
    (tmp_path / "orbits" / "40014.json").write_text(json.dumps([omm(40014)]))
    settings = Settings(
        data_dir=tmp_path, satnogs_url=fake.url, orbit_url=f"{fake.url}/orbits/{{norad_id}}.tle",
        orbit_folder=tmp_path / "orbits",
    )  # fmt: skip
    add(database, a="40014")
    found = [look(database, settings, source) for source in ("satnogs", "url", "folder")]
    assert [states for ((_, states),) in found] == ["new", "new", "new"]
    assert sorted(row.format for row in orbits(database)) == ["omm", "tle", "tle"]


def test_the_setting_and_the_command_know_every_source():
    from app.cli.orbits import SOURCES

    (names, _none) = get_args(Settings.model_fields["orbit_source"].annotation)
    assert set(get_args(names)) == set(ORBIT_SOURCES) == set(SOURCES)


def test_a_server_watches_where_asked_and_readyz_says_what_is_stopped(new_service, serve):
    import time

    import httpx2

    fake = serve(celestrak)
    service = new_service(celestrak_url=fake.url)
    with service.client() as api:
        api.post("/satellites", json={"id": "a", "norad_id": "25544"}).raise_for_status()
    folder = service.settings.data_dir
    service.server.should_exit = True
    fake.answer = lambda _asked: (403, {}, b"")
    again = new_service(celestrak_url=fake.url, orbit_source="celestrak", data_dir=folder)
    deadline = time.monotonic() + 30.0
    while (found := httpx2.get(f"{again.url}/readyz", trust_env=False).json())["sources"] == "ok":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert found["status"] == "ok"
    assert found["sources"].startswith("celestrak: it answered 403")


def test_nothing_is_asked_with_default_settings(new_service, serve):
    """A server with no settings but where the catalogue would be: it is never asked, and no name is looked up."""
    fake = serve(celestrak)
    service = new_service(celestrak_url=fake.url, satnogs_url=fake.url, space_track_url=fake.url)
    with service.client() as api:
        api.post("/satellites", json={"id": "a", "norad_id": "25544"}).raise_for_status()
        api.get("/satellites/a").raise_for_status()
    assert fake.asked == []


def space_track(elements, log):
    """Answer as Space-Track does, ``gp`` and ``gp_history`` by its ranges of EPOCH; ``log`` has the day's queries."""

    def answer(asked):
        if asked.path == "/ajaxauth/login":
            return 200, {"set-cookie": "chocolatechip=1; Path=/"}, b'""'
        words = asked.path.removeprefix("/basicspacedata/query/").split("/")
        query = dict(zip(words[::2], words[1::2], strict=True))
        number = int(query["NORAD_CAT_ID"])
        epochs = elements
        if query["class"] == "gp_history":
            first, last = query["EPOCH"].split("--")
            log.append((number, first, last))
            epochs = [one for one in elements if first <= one < last]
        else:
            epochs = sorted(elements)[-1:]
        found = [{name: str(value) for name, value in omm(number, epoch=one).items()} for one in epochs]
        return 200, {}, json.dumps(found).encode()

    return answer


def keep_session(database: Database, begin: str, hours: float = 3.0, satellite: str = "a") -> None:
    first = datetime.fromisoformat(begin).replace(tzinfo=UTC)
    with database.write() as session:
        if session.get(Magnetometer, (satellite, "m")) is None:
            session.add(Magnetometer(satellite_id=satellite, id="m", unit="nT", created_at=utc_now()))
            session.flush()
        session.add(
            TelemetrySession(
                id=new_id(),
                satellite_id=satellite,
                magnetometer_id="m",
                state="closed",
                size_bytes=1,
                samples=1,
                used_samples=1,
                data_from=first,
                data_until=first + timedelta(hours=hours),
                columns=[],
                quality={},
                sha256=new_id(),
                created_at=utc_now(),
            )
        )


@pytest.fixture
def track(serve, tmp_path):
    """Space-Track with elements at noon of each day of 2022 and of yesterday, its settings, its queries of the past."""
    days = [str(np.datetime64("2022-01-01") + day) + "T12:00:00" for day in range(365)]
    recent = (utc_now() - timedelta(days=1)).strftime("%Y-%m-%dT%H:%M:%S")
    log: list[tuple[int, str, str]] = []
    fake = serve(space_track([*days, recent], log))
    secret = tmp_path / "password"
    secret.write_text("secret\n")
    settings = Settings(
        data_dir=tmp_path, space_track_url=fake.url, space_track_user="me", space_track_password_file=secret
    )
    return fake, settings, log


def test_the_elements_of_the_past_about_sessions_are_fetched_and_each_span_once(database, track):
    """Two sessions of one month are one query, one of November is another; one that has an orbit near is none."""
    _, settings, log = track
    add(database, a="25544", b="25545")
    for begin in ("2022-02-19T22:37:44", "2022-03-10T01:00:00", "2022-11-05T12:00:00"):
        keep_session(database, begin)
    assert look(database, settings, "space-track") == [("a", "new"), ("a", "past"), ("b", "new")]
    assert log == [(25544, "2022-02-17", "2022-03-13")]
    for _ in range(3):
        assert look(database, settings, "space-track") == [("a", "not yet"), ("b", "not yet")]
    hours_go_by(database, 2.3)
    assert look(database, settings, "space-track") == [("a", "not yet"), ("a", "past"), ("b", "not yet")]
    assert log[1:] == [(25544, "2022-11-03", "2022-11-08")]
    kept = sorted(str(row.epoch)[:10] for row in orbits(database) if row.satellite_id == "a")[:-1]
    assert kept == [
        str(day) for first, last in (log[0][1:], log[1][1:]) for day in np.arange(first, last, dtype="M8[D]")
    ]
    hours_go_by(database, 30.0)
    look(database, settings, "space-track")
    assert len(log) == 2


def test_a_past_without_elements_is_asked_for_once_and_an_outage_again(database, track):
    fake, settings, log = track
    add(database, a="25544")
    keep_session(database, "2019-05-05T00:00:00")
    whole = fake.answer
    fake.answer = lambda asked: (200, {}, b"<html>maintenance</html>") if "history" in asked.path else whole(asked)
    assert look(database, settings, "space-track") == [("a", "new"), ("a", "failed")]
    fake.answer = whole
    hours_go_by(database, 2.3)
    assert look(database, settings, "space-track") == [("a", "not yet"), ("a", "no past")]
    hours_go_by(database, 2.3)
    assert look(database, settings, "space-track") == [("a", "not yet")]
    assert log == [(25544, "2019-05-03", "2019-05-08")]
    fake.answer = lambda asked: (403, {}, b"") if "history" in asked.path else whole(asked)
    keep_session(database, "2020-05-05T00:00:00")
    hours_go_by(database, 2.3)
    assert look(database, settings, "space-track")[-1] == ("a", "failed")
    asked = len(fake.asked)
    hours_go_by(database, 100.0)
    look(database, settings, "space-track")
    assert len(fake.asked) == asked
    assert "403" in stopped_sources(database)[0]


def test_the_limits_hold_for_both_classes_together_over_restarts(database, track):
    """Ten satellites with a session each: 15 asks are a minute's 30 requests; 300 an hour are 150 asks of any kind."""
    fake, settings, _ = track
    add(database, **{f"s{n:02d}": str(30000 + n) for n in range(10)})
    for n in range(10):
        keep_session(database, "2022-06-01T00:00:00", satellite=f"s{n:02d}")
    states = [state for _ in range(3) for _, state in look(database, settings, "space-track")]
    assert (states.count("new"), states.count("past"), len(fake.asked)) == (8, 7, 30)
    with database.write() as session:
        earlier = utc_now() - timedelta(minutes=5)
        session.execute(update(ConnectorRequest).values(asked_at=earlier))
        session.add_all(
            ConnectorRequest(id=new_id(), source="space-track-past", satellite_id="s00", asked_at=earlier)
            for _ in range(135 - 2)
        )
    look(database, settings, "space-track")
    assert len(fake.asked) == 30 + 2 * 2

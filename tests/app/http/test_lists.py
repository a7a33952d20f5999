"""Lists that are copied rather than read and written out again, what entity tags promise, and how lists are found."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from datetime import timedelta

import pytest
from sqlalchemy import text

from app.access.caller import SYSTEM
from app.http.entity_tags import LONGEST_BYTES
from app.jobs.tables import Job
from app.parameter_sets.json_listing import Texts
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import ParameterSetQuery
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.records.json_numbers import without_nan
from app.sessions.tables import TelemetrySession
from app.storage.database import new_id, utc_now
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of

COUNT = 7


@pytest.fixture(scope="module")
def record() -> dict:
    found = calibrate(simulated(SESSIONS[0]).samples, [Sgp4Orbit(tle_of(SESSIONS[0]))], method="scalar")
    return json.loads(json.dumps(without_nan(found.to_dict())))


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def service(request, new_service: Callable, record: dict) -> Iterator:
    """A service with one magnetometer, two sessions and seven parameter sets, as a worker keeps them."""
    url = {"database_url": request.getfixturevalue("postgres_url")} if request.param == "postgres" else {}
    service = new_service(**url)
    with service.client() as admin:
        admin.post("/satellites", json={"id": "one"}).raise_for_status()
        admin.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    place = {"satellite_id": "one", "magnetometer_id": "mgm"}
    with service.database.write() as session:
        sessions = [new_id() for _ in range(2)]
        empty = {"size_bytes": 0, "samples": 0, "used_samples": 0, "columns": [], "quality": {}, "state": "closed"}
        session.add_all(TelemetrySession(id=one, created_at=utc_now(), **place, **empty) for one in sessions)
        for number in range(COUNT):
            add_set(session, record, place, sessions[: number % 3], number)
    return service


def add_set(session, record: dict, place: dict, session_ids: list[str], number: int) -> None:
    job, one, now = new_id(), new_id(), utc_now()
    plain = {"priority": 0, "progress": 1.0, "attempts": 1, "lost_attempts": 0, "cancel_requested": False}
    session.add(Job(id=job, kind="calibration", state="succeeded", request={}, created_at=now, **plain, **place))
    session.flush()
    kept = record if number % 2 else {"odd": 'é \\u0022 "', "created_at": "never"} | record
    session.add(
        ParameterSet(
            id=one,
            job_id=job,
            status="candidate",
            grade="accept",
            method="scalar",
            data_from=now,
            data_until=now,
            record=kept,
            residuals_sha256="0" * 64,
            created_at=now + timedelta(microseconds=number),
            **place,
        )
    )
    session.flush()
    session.add_all(ParameterSetSession(parameter_set_id=one, session_id=each) for each in session_ids)


def plain_of(service, query: ParameterSetQuery) -> list[dict]:
    """What reading each record into its model and writing it out again says: the slow way."""
    with service.database.read() as session:
        sets = ParameterSetRepository(session, SYSTEM)
        rows = sets.page(query).rows
        return [json.loads(one.model_dump_json()) for one in sets.read(rows)]


def test_a_copied_list_says_what_reading_every_record_says(service):
    with service.client() as admin:
        first = admin.get("/parameter-sets", params={"satellite": "one"}).json()
        again = admin.get("/parameter-sets", params={"satellite": "one", "limit": COUNT}).json()
        alone = [admin.get(f"/parameter-sets/{one['id']}").json() for one in first["items"]]
    assert len(first["items"]) == COUNT
    assert first["items"] == again["items"] == alone == plain_of(service, ParameterSetQuery(satellite="one"))


def test_every_part_by_cursor_is_the_same_slice_of_the_whole(service):
    with service.client() as admin:
        whole = admin.get("/parameter-sets").json()
        parts, cursor = [], ""
        while cursor is not None:
            part = admin.get("/parameter-sets", params={"limit": 3} | ({"cursor": cursor} if cursor else {})).json()
            parts, cursor = parts + part["items"], part["next"]
    assert (parts, whole["next"]) == (whole["items"], None)


def test_a_tag_spares_the_content_until_a_status_moves(service):
    with service.client() as admin:
        first = admin.get("/parameter-sets")
        tag = {"if-none-match": first.headers["etag"]}
        for _ in range(3):
            same = admin.get("/parameter-sets", headers=tag)
            assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", first.headers["etag"])
        assert (
            admin.get("/parameter-sets", headers={"if-none-match": f'"x", W/{tag["if-none-match"]}'}).status_code == 304
        )
        one = first.json()["items"][2]["id"]
        own = admin.get(f"/parameter-sets/{one}").headers["etag"]
        admin.post(f"/parameter-sets/{one}/activate").raise_for_status()
        moved = admin.get("/parameter-sets", headers=tag)
        assert (moved.status_code, moved.json()["items"][2]["status"]) == (200, "active")
        assert admin.get(f"/parameter-sets/{one}", headers={"if-none-match": own}).json()["status"] == "active"


def test_a_tag_opens_nothing_to_a_key_without_reach_or_after_its_end(service):
    with service.client() as admin:
        tag = {"if-none-match": admin.get("/parameter-sets").headers["etag"]}
        made = admin.post("/keys", json={"scopes": ["read"]}).json()
        with service.client(made["key"]) as reader:
            assert [reader.get("/parameter-sets", headers=tag).status_code for _ in range(2)] == [304, 304]
            admin.post(f"/keys/{made['id']}/revoke").raise_for_status()
            assert reader.get("/parameter-sets", headers=tag).status_code == 401
        with service.client(service.key("read", satellites=["another"])) as stranger:
            answer = stranger.get("/parameter-sets", headers=tag)
            assert (answer.status_code, answer.json()["items"]) == (200, [])
        with service.client("") as nobody:
            assert nobody.get("/parameter-sets", headers=tag).status_code == 401


def test_an_answer_from_memory_ends_with_the_next_commit_of_anybody(service):
    """The revision is the database's own, so a commit past the service counts too."""
    with service.client() as admin:
        before = [admin.get("/parameter-sets").json()["items"][0]["status"] for _ in range(3)]
        with service.database.engine.begin() as connection:
            connection.execute(text("UPDATE parameter_set SET status = 'retired'"))
        assert before == ["candidate"] * 3
        assert {one["status"] for one in admin.get("/parameter-sets").json()["items"]} == {"retired"}


def test_an_answer_that_is_sent_in_pieces_is_whole_the_first_time_and_from_memory(service, monkeypatch):
    with service.client() as admin:
        whole = admin.get("/parameter-sets?limit=7")
        monkeypatch.setattr("app.http.entity_tags.PIECE_BYTES", 999)
        pieces = [admin.get("/parameter-sets?limit=6") for _ in range(3)]
        monkeypatch.undo()
    assert len(whole.content) > 20 * 999
    for one in pieces:
        assert one.json()["items"] == whole.json()["items"][:6]
        assert one.headers["content-length"] == str(len(one.content))
        assert one.headers.keys() == whole.headers.keys()


def test_what_is_kept_at_hand_is_bounded(service, monkeypatch):
    monkeypatch.setattr("app.parameter_sets.json_listing.MOST_BYTES", 20_000)
    texts = Texts()
    with service.database.engine.connect() as connection:
        sets = [tuple(row) for row in connection.execute(text("SELECT id, status FROM parameter_set"))]
        first = texts.of(connection, sets)
        assert texts.of(connection, sets) == first
    assert len(first) == COUNT
    assert sum(map(len, texts._texts.values())) == texts._size <= 20_000 < sum(map(len, first)) < LONGEST_BYTES


def test_the_set_in_force_at_a_time_is_the_last_one_begun_unless_it_had_ended(service):
    with service.client() as admin:
        ids = [one["id"] for one in admin.get("/parameter-sets").json()["items"]]
    begin = utc_now() - timedelta(days=10)
    spans = [(0, 1), (1, 2), (3, 3), (3, 4)]
    with service.database.write() as session:
        for (begun, ended), one in zip(spans, ids, strict=False):
            times = {"begun_at": begin + timedelta(days=begun), "ended_at": begin + timedelta(days=ended)}
            place = {"satellite_id": "one", "magnetometer_id": "mgm", "parameter_set_id": one}
            session.add(Activation(id=new_id(), **place, **times))
    with service.client() as admin:
        for days, wanted in ((-0.5, []), (0.0, [0]), (0.5, [0]), (1.0, [1]), (2.0, []), (2.5, []), (3.5, [3]), (9, [])):
            at = (begin + timedelta(days=days)).isoformat()
            for where in ({}, {"satellite": "one"}, {"satellite": "one", "magnetometer": "mgm"}):
                found = admin.get("/parameter-sets", params={"at": at, **where}).json()["items"]
                assert [one["id"] for one in found] == [ids[number] for number in wanted], days
            assert admin.get("/parameter-sets", params={"at": at, "satellite": "two"}).json()["items"] == []


def test_lists_count_search_sort_and_sum_up_on_request(api, names):
    """Totals are of all parts; `sort` turns the order round and parts still join; a search takes a part of an id."""
    made = [next(names) for _ in range(3)]
    for name in made:
        api.post("/satellites", json={"id": name, "name": f"Heron {name}"}).raise_for_status()
    whole = api.get("/satellites", params={"q": "hEron", "total": "true", "sort": "created"}).json()
    assert ([one["id"] for one in whole["items"]], whole["total"]) == (made, 3)
    first = api.get("/satellites", params={"q": "heron", "sort": "created", "limit": 2, "total": "true"}).json()
    query = {"q": "heron", "sort": "created", "limit": 2, "cursor": first["next"]}
    assert [one["id"] for one in first["items"] + api.get("/satellites", params=query).json()["items"]] == made
    assert first["total"] == 3
    assert "total" not in api.get("/satellites").json()
    assert api.get("/satellites", params={"q": "100%", "total": "true"}).json()["total"] == 0
    for path in ("/jobs", "/sessions", "/parameter-sets"):
        answer = api.get(path, params={"total": "true", "q": "no-such-thing"})
        assert (answer.status_code, answer.json()["total"], answer.json()["items"]) == (200, 0, [])
    jobs = api.get("/jobs", params={"total": "true", "state": "failed", "limit": 1}).json()
    assert jobs["total"] == jobs["counts"].get("failed", 0)


def test_every_list_that_offers_a_total_says_it(service) -> None:
    """The calls are those of the API's own description; what they are about is there once at least."""
    with service.client() as api:
        api.post("/webhooks", json={"url": "http://127.0.0.1:9/", "events": ["job.ended"]})
        known = {
            "satellite_id": "one",
            "magnetometer_id": "mgm",
            "session_id": api.get("/sessions").json()["items"][0]["id"],
            "parameter_set_id": api.get("/parameter-sets").json()["items"][0]["id"],
        }
        hooks = api.get("/webhooks").json()["items"]
        known |= {"webhook_id": hooks[0]["id"]} if hooks else {}
        paths = api.get(f"{service.url}/openapi.json").json()["paths"]
        asked = 0
        for path, calls in paths.items():
            names = [one["name"] for one in calls.get("get", {}).get("parameters", [])]
            if "total" not in names or ("{webhook_id}" in path and not hooks):
                continue
            address = path.removeprefix("/api/v1").format_map(known)
            plain, counted = (api.get(address, params={"limit": 1000} | more) for more in ({}, {"total": True}))
            if path != "/api/v1/fleet":  # which says it unless asked not to
                assert plain.json().get("total") is None, path
            assert counted.status_code == 200, path
            if path != "/api/v1/overview":
                assert counted.json()["total"] == len(plain.json()["items"]), path
            one = api.get(address, params={"limit": 1, "total": True})
            assert one.json()["total"] == counted.json()["total"], path
            (sort,) = (one for one in calls["get"]["parameters"] if one["name"] == "sort")
            for order in sort["schema"]["enum"]:
                found = api.get(address, params={"sort": order, "q": "no-such-thing", "view": "summary"})
                assert (found.status_code, found.json()["items"]) == (200, []), (path, order)
            asked += 1
        assert asked >= 15
        assert api.get("/overview", params={"total": True}).json()["total"] == 1


@pytest.mark.parametrize("path", ["/overview", "/attention", "/fleet", "/satellites/one/history", "/jobs"])
def test_what_displays_ask_for_again_and_again_is_answered_304_until_it_changes(service, path: str) -> None:
    with service.client() as api:
        first = api.get(path)
        tag = first.headers["etag"]
        assert api.get(path, headers={"If-None-Match": tag}).status_code == 304
        newest = api.get("/parameter-sets?limit=1").json()["items"][0]["id"]
        with service.database.write() as session:
            session.execute(text("UPDATE job SET priority = 7"))
        api.post(f"/parameter-sets/{newest}/activate", json={}).raise_for_status()
        after = api.get(path, headers={"If-None-Match": tag})
        assert after.status_code == 200
        assert after.headers["etag"] != tag

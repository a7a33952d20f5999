"""What belongs to another satellite is not there: every call with an id, body, filter or cursor (A3, A4)."""

from __future__ import annotations

import json
import statistics
import time

import pytest

ABSENT = "0" * 32
ACTS_ON_SATELLITE = {"satellite_id", "session_id", "job_id", "parameter_set_id"}


@pytest.fixture(scope="module")
def stranger(service, names):
    """A client that may do everything, for another satellite."""
    own = next(names)
    with service.client() as admin:
        admin.post("/satellites", json={"id": own}).raise_for_status()
        admin.post(f"/satellites/{own}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    with service.client(service.key("read", "ingest", "operate", "admin", satellites=[own])) as client:
        client.headers["x-own"] = own
        yield client


@pytest.fixture(scope="module")
def nowhere(world):
    """The same kinds of ids, of things that do not exist."""
    kept = {"magnetometer_id": "mgm", "satellite_id": "sat-nowhere"}
    return type(world)("sat-nowhere", {name: kept.get(name, ABSENT) for name in world.ids}, world.telemetry)


def guarded_by_id(guarded):
    return [one for one in guarded if ACTS_ON_SATELLITE & set(one.parameters)]


def test_every_call_by_id_answers_as_if_it_did_not_exist(stranger, world, nowhere, guarded):
    """Byte for byte the same answer, with sound bodies and with none."""
    wrong = []
    for operation in guarded_by_id(guarded):
        for is_sound in (True, False):
            theirs, nobodys = (
                stranger.request(operation.method, one.url(operation), **(one.request(operation) if is_sound else {}))
                for one in (world, nowhere)
            )
            if is_sound and theirs.status_code != 404:
                wrong.append(f"{operation.name}: {theirs.status_code}")
            if (theirs.status_code, theirs.content) != (nobodys.status_code, nobodys.content):
                wrong.append(f"{operation.name}, sound={is_sound}: {theirs.text} against {nobodys.text}")
    assert wrong == []


def test_foreign_ids_in_bodies_and_queries_answer_as_if_they_did_not_exist(stranger, world):
    session, sets = world.ids["session_id"], world.ids["parameter_set_id"]
    own = stranger.headers["x-own"]
    pairs = [
        [("POST", "/jobs", {"json": {"kind": "calibration", "session_ids": [one]}}) for one in (session, ABSENT)],
        [("GET", "/figures/compare", {"params": {"first": one, "second": one}}) for one in (sets, ABSENT)],
        [("GET", "/overview", {"params": {"satellite": one}}) for one in (world.satellite, "sat-nowhere")],
        [("POST", "/satellites", {"json": {"id": one}}) for one in (world.satellite, "sat-nowhere")],
    ]
    for theirs, nobodys in pairs:
        answers = [stranger.request(method, path, **options) for method, path, options in (theirs, nobodys)]
        assert answers[0].status_code == 404, theirs
        assert answers[0].content == answers[1].content, theirs
    assert stranger.get(f"/satellites/{own}").status_code == 200


@pytest.mark.parametrize("path", ["/satellites", "/sessions", "/jobs", "/parameter-sets", "/overview"])
def test_lists_and_filters_show_nothing_of_it(stranger, world, path):
    filters = {
        "/sessions": ["satellite"],
        "/jobs": ["satellite", "session"],
        "/parameter-sets": ["satellite", "session"],
    }
    values = {"satellite": world.satellite, "session": world.ids["session_id"]}
    queries = [{}, *({name: values[name]} for name in filters.get(path, ()))]
    for query in queries:
        answer = stranger.get(path, params=query)
        assert answer.status_code == 200
        assert world.satellite not in answer.text
        assert all(one not in answer.text for name, one in world.ids.items() if name.endswith("_id") and len(one) > 16)


def test_a_cursor_of_another_key_shows_nothing_of_it(api, stranger, world):
    cursor = api.get("/sessions", params={"limit": 1}).json()["next"]
    if cursor is not None:
        assert world.satellite not in stranger.get("/sessions", params={"cursor": cursor}).text


def test_two_sessions_of_two_satellites_make_no_job(service, api, world, names):
    """Not even for a key that reaches both: a parameter set is of one magnetometer."""
    other = next(names)
    api.post("/satellites", json={"id": other}).raise_for_status()
    api.post(f"/satellites/{other}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    sent = api.post(
        f"/satellites/{other}/sessions",
        params={"magnetometer": "mgm"},
        content=world.telemetry,
        headers={"content-type": "text/csv"},
    ).json()
    mixed = {"kind": "calibration", "session_ids": [sent["id"], world.ids["session_id"]]}
    assert api.post("/jobs", json=mixed).status_code == 422
    with service.client(service.key("operate", satellites=[other])) as bound:
        assert bound.post("/jobs", json=mixed).status_code == 404


def test_an_idempotency_key_of_another_key_holder_is_another_key(stranger, api, world):
    """The second holder learns neither that the first used it nor for what."""
    own, headers = stranger.headers["x-own"], {"content-type": "text/csv", "idempotency-key": "pass-42"}
    query, telemetry = {"magnetometer": "mgm"}, world.telemetry
    first = api.post(f"/satellites/{world.satellite}/sessions", params=query, content=telemetry, headers=headers)
    second = stranger.post(f"/satellites/{own}/sessions", params=query, content=telemetry, headers=headers)
    assert (first.status_code, second.status_code) == (200, 201)
    assert first.json()["id"] != second.json()["id"]


def test_the_bytes_of_another_satellite_leave_no_sign(service, stranger, world, names):
    """Equal bytes are new here (201) with an answer of the same shape, and take as long as bytes nobody has sent.

    The medians of twelve interleaved pairs differ by less than half: a deduplication that skipped the reading would
    show as several times. A finer bound would test the machine.
    """
    own = stranger.headers["x-own"]
    lines = world.telemetry.splitlines(keepends=True)
    took = {"known": [], "unknown": []}
    with service.client() as admin:
        for number in range(12):
            known = b"".join(lines[: 40 + number])
            unknown = known.replace(b"\n", b" \n", 1)
            query = {"magnetometer": "mgm"}
            headers = {"content-type": "text/csv"}
            path = f"/satellites/{world.satellite}/sessions"
            admin.post(path, params=query, content=known, headers=headers).raise_for_status()
            pair = [("known", known), ("unknown", unknown)]
            for kind, content in pair if number % 2 else pair[::-1]:
                begun = time.perf_counter()
                answer = stranger.post(f"/satellites/{own}/sessions", params=query, content=content, headers=headers)
                took[kind].append(time.perf_counter() - begun)
                assert answer.status_code == 201
                assert world.satellite not in answer.text
    known_s, unknown_s = (statistics.median(one) for one in took.values())
    assert 0.5 < known_s / unknown_s < 2.0


def test_the_pages_of_the_dashboard_are_shells_that_carry_no_data(service, world):
    """A page tells nothing; what fills it comes from the API, with the login's own reach."""
    with service.client("") as client:
        page = client.get(f"{service.url}/satellites/{world.satellite}")
        assert page.status_code == 200
        assert world.ids["session_id"] not in page.text
        assert json.dumps(world.ids["parameter_set_id"]) not in page.text


def test_the_figures_for_operators_name_no_satellite(service, world):
    with service.client("") as client:
        metrics = client.get(f"{service.url}/metrics").text
    assert "magcal_jobs" in metrics
    assert all(one not in metrics for one in (world.satellite, world.ids["session_id"], world.ids["key_id"]))

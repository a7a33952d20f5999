"""Orbits over HTTP."""

import json
import time
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from sqlalchemy import event, select

from app.access.caller import SYSTEM
from app.orbits.nearest import chosen
from app.orbits.repository import OrbitRepository
from app.orbits.tables import OrbitRow
from magcal_core.errors import OptionError
from magcal_core.orbit.messages.tle import checksum
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

TEXT = {"content-type": "text/plain"}
STATE = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "GCRF",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}
OEM = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2022-02-20T00:00:00
ORIGINATOR = TEST
META_START
OBJECT_NAME = DEKART
OBJECT_ID = 2020-068H
CENTER_NAME = EARTH
REF_FRAME = ITRF2000
TIME_SYSTEM = UTC
START_TIME = 2022-02-20T00:00:00
STOP_TIME = 2022-02-20T00:04:00
META_STOP
2022-02-20T00:00:00 6900.0 0.0 0.0 0.0 0.0 7.6
2022-02-20T00:01:00 6885.0 0.0 455.4 -0.5 0.0 7.58
2022-02-20T00:02:00 6840.1 0.0 908.7 -1.0 0.0 7.53
2022-02-20T00:03:00 6765.5 0.0 1358.1 -1.5 0.0 7.45
2022-02-20T00:04:00 6661.5 0.0 1801.6 -2.0 0.0 7.34
"""


def send(api, satellite, content, media_type="text/plain"):
    return api.post(f"/satellites/{satellite}/orbits", content=content, headers={"content-type": media_type})


def test_tles_are_kept_once_each(api, satellite):
    made = send(api, satellite, tle_text())
    assert made.status_code == 201
    items = made.json()["items"]
    assert [(one["format"], one["details"]["norad_id"]) for one in items] == [("tle", "46493")] * 2
    assert items[0]["epoch"] == "2022-02-19T22:37:44.129568Z"
    again = send(api, satellite, tle_text().replace("\n", "\r\n"))
    assert again.status_code == 200
    assert [one["id"] for one in again.json()["items"]] == [one["id"] for one in items]
    listed = api.get(f"/satellites/{satellite}/orbits").json()["items"]
    assert [one["id"] for one in listed] == [items[1]["id"], items[0]["id"]]


def test_the_orbit_of_a_time_is_the_nearest_with_its_age(api, satellite):
    send(api, satellite, tle_text())
    chosen = api.get(f"/satellites/{satellite}/orbits", params={"at": "2022-02-21T22:37:44.129568Z"}).json()["items"]
    assert [one["epoch"][:10] for one in chosen] == ["2022-02-19"]
    assert chosen[0]["age_days"] == pytest.approx(2.0, abs=1e-9)


def test_an_ephemeris_serves_the_times_that_it_covers(api, satellite):
    send(api, satellite, tle_text())
    made = send(api, satellite, OEM)
    assert (made.status_code, made.json()["items"][0]["format"]) == (201, "oem")
    path = f"/satellites/{satellite}/orbits"
    inside = api.get(path, params={"at": "2022-02-20T00:02:00Z"}).json()["items"][0]
    outside = api.get(path, params={"at": "2022-02-20T00:10:00Z"}).json()["items"][0]
    assert (inside["format"], inside["age_days"], outside["format"]) == ("oem", 0.0, "tle")


def test_a_state_vector_is_an_orbit(api, satellite):
    made = send(api, satellite, json.dumps(STATE), "application/json")
    assert made.status_code == 201, made.text
    orbit = made.json()["items"][0]
    assert (orbit["format"], orbit["epoch"]) == ("state", "2022-02-19T22:37:44.130000Z")
    detail = api.get(f"/satellites/{satellite}/orbits/{orbit['id']}").json()
    assert json.loads(detail["content"])["position_km"] == STATE["position_km"]


def test_a_wrong_checksum_is_told_by_line_and_column(api, satellite):
    refused = send(api, satellite, tle_text().replace("9996", "9997"))
    assert (refused.status_code, refused.json()["code"]) == (422, "tle_checksum")
    assert refused.json()["errors"][0]["where"] == "line 2, column 69"
    assert api.get(f"/satellites/{satellite}/orbits").json()["items"] == []


def test_what_is_no_orbit_is_refused(api, satellite):
    for content, media_type in (
        ("hello", "text/plain"),
        ('{"epoch": "2022-02-19T22:37:44Z"}', "application/json"),
        ("<xml", "application/xml"),
        (json.dumps(STATE | {"frame": "MOON"}), "application/json"),
    ):
        assert send(api, satellite, content, media_type).status_code == 422, content
    assert send(api, satellite, b"\xff\xfe", "text/plain").json()["code"] == "encoding"
    assert send(api, satellite, "x", "image/png").status_code == 415


def test_orbits_of_another_satellite_are_not_there(service, api, satellite):
    orbit_id = send(api, satellite, tle_text()).json()["items"][0]["id"]
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        nothing = bound.get("/satellites/nowhere/orbits")
        assert bound.get(f"/satellites/{satellite}/orbits").content == nothing.content
        assert bound.get(f"/satellites/{satellite}/orbits/{orbit_id}").content == nothing.content
        assert send(bound, satellite, tle_text()).status_code == 404


def mission_tles(count: int) -> str:
    """Return ``count`` TLEs of one satellite over two years, made from one: the epoch and the anomaly move."""
    lines = []
    for k in range(count):
        days = 730.0 * k / count
        year, day = 21 + int(days // 365), 1.0 + days % 365
        first = f"1 46493U 20068H   {year:02d}{day:012.8f}  .00000000  00000-0  00000+0 0  999"
        anomaly = (33.6 + 15.04 * 360.0 * days) % 360.0
        second = f"2 46493  97.7186 352.5293 0017269 326.3404 {anomaly:8.4f} 15.04187815    0"
        lines += [f"{line}{sum(int(c) if c.isdigit() else c == '-' for c in line) % 10}" for line in (first, second)]
    return "\n".join(lines) + "\n"


def test_the_tles_of_a_mission_are_kept_at_once(new_service):
    """1,500 TLEs over two years, many to a statement."""
    service = new_service()
    statements: list[str] = []
    with service.client() as api:
        api.post("/satellites", json={"id": "many"}).raise_for_status()
        event.listen(service.database.engine, "before_cursor_execute", lambda *told: statements.append(told[2]))
        content = mission_tles(1500)
        first = api.post("/satellites/many/orbits", content=content, headers=TEXT)
        assert len(statements) < 150
        again = api.post("/satellites/many/orbits", content=content, headers=TEXT)
    assert (first.status_code, again.status_code) == (201, 200)
    ids = [one["id"] for one in first.json()["items"]]
    assert len(set(ids)) == 1500
    assert [one["id"] for one in again.json()["items"]] == ids
    epochs = [one["epoch"] for one in first.json()["items"]]
    assert epochs == sorted(epochs)


def test_a_long_session_is_served_by_all_its_tles(api, service, satellite):
    """1,500 TLEs over two years, a session over nearly all of them: each is the nearest to some of the data."""
    send(api, satellite, mission_tles(1500))
    begin, end = datetime(2021, 3, 1, tzinfo=UTC), datetime(2022, 11, 1, tzinfo=UTC)
    with service.database.read() as session:
        orbits = OrbitRepository(session, SYSTEM, satellite)
        rows = orbits.around(begin, end, 14.0)
        every = {
            row.id: row.epoch for row in session.scalars(select(OrbitRow).where(OrbitRow.satellite_id == satellite))
        }
        inside = {one for one, epoch in every.items() if begin <= epoch <= end}
        assert len(inside) > 1000
        assert inside <= {row.id for row in rows}
        for at in (begin, end, begin - timedelta(hours=12), end + timedelta(hours=12)):
            assert chosen(rows, at).epoch == min(every.values(), key=lambda epoch: abs(epoch - at))


@pytest.mark.parametrize("seed", range(3))
def test_what_may_serve_is_found_by_one_statement_as_by_looking_at_every_orbit(api, service, satellite, seed):
    """Epochs, ephemerides and withdrawals drawn at random, against the rule written out in Python."""
    rng = np.random.default_rng(seed)
    start = datetime(2022, 1, 1, tzinfo=UTC)
    rows = []
    for number in range(60):
        epoch = start + timedelta(hours=float(rng.uniform(0, 400)))
        until = epoch + timedelta(hours=float(rng.uniform(1, 60))) if rng.random() < 0.3 else None
        withdrawn = start if rng.random() < 0.2 else None
        rows.append(OrbitRow(
            id=f"{satellite}-{number}"[-32:], satellite_id=satellite, format="tle", name=None, epoch=epoch, until=until,
            content="", sha256=f"{number:064d}", details={}, created_at=start, created_by=None, withdrawn_at=withdrawn,
            withdrawn_by=None,
        ))  # fmt: skip
    with service.database.write() as session:
        session.add_all(rows)
    used = [row for row in rows if row.withdrawn_at is None]
    states = [row for row in used if row.until is None]
    with service.database.read() as session:
        orbits = OrbitRepository(session, SYSTEM, satellite)
        for first, hours in ((-50.0, 1.0), (100.0, 3.0), (200.0, 90.0), (390.0, 40.0)):
            begin = start + timedelta(hours=first)
            end = begin + timedelta(hours=hours)
            wanted = {row.id for row in used if row.until is not None and row.epoch <= end and row.until >= begin}
            day = timedelta(days=1)
            wanted |= {row.id for row in states if begin - day <= row.epoch <= end + day}
            before = [row for row in states if row.epoch <= begin]
            after = [row for row in states if row.epoch >= end]
            wanted |= {max(before, key=lambda row: row.epoch).id} if before else set()
            wanted |= {min(after, key=lambda row: row.epoch).id} if after else set()
            found = orbits.around(begin, end, 14.0)
            assert {row.id for row in found} == wanted
            assert [row.epoch for row in found] == sorted(row.epoch for row in found)


def test_more_orbits_than_a_calibration_takes_are_refused_and_not_cut(api, service, satellite, monkeypatch):
    send(api, satellite, mission_tles(40))
    monkeypatch.setattr("app.orbits.repository.MOST_STATES", 10)
    with service.database.read() as session, pytest.raises(OptionError, match="more than 10 TLEs serve the data"):
        orbits = OrbitRepository(session, SYSTEM, satellite)
        orbits.around(datetime(2021, 1, 1, tzinfo=UTC), datetime(2022, 12, 31, tzinfo=UTC), 14.0)


def test_an_orbit_that_stands_twice_in_a_message_is_kept_once(api, satellite):
    content = mission_tles(2) + mission_tles(2)
    answer = api.post(f"/satellites/{satellite}/orbits", content=content, headers={"content-type": "text/plain"})
    ids = [one["id"] for one in answer.json()["items"]]
    assert answer.status_code == 201
    assert ids[:2] == ids[2:]
    assert len(set(ids)) == 2


def test_an_orbit_of_another_object_is_refused_unless_it_is_forced(api, names):
    """DEKART's TLEs for a satellite of another NORAD id, of another COSPAR id, and of its own in another writing."""
    for ids, said in (({"norad_id": "25544"}, "NORAD id 46493, the satellite's is 25544"),
                      ({"cospar_id": "1998-067A"}, "COSPAR id 2020-068H, the satellite's is 1998-067A")):  # fmt: skip
        name = next(names)
        api.post("/satellites", json={"id": name} | ids).raise_for_status()
        send = {"content": tle_text(), "headers": {"content-type": "text/plain"}}
        refused = api.post(f"/satellites/{name}/orbits", **send)
        assert (refused.status_code, refused.json()["code"]) == (409, "other_object")
        assert said in refused.json()["detail"]
        assert "force=true" in refused.json()["detail"]
        assert api.get(f"/satellites/{name}/orbits").json()["items"] == []
        assert api.post(f"/satellites/{name}/orbits", params={"force": "true"}, **send).status_code == 201
    name = next(names)
    api.post("/satellites", json={"id": name, "norad_id": "046493", "cospar_id": "20068H"}).raise_for_status()
    assert api.post(f"/satellites/{name}/orbits", **send).status_code == 201


@pytest.mark.parametrize(
    ("object_id", "status"),
    [
        ("2020-068H", 201), ("20068H", 201), ("UNKNOWN", 201), ("N/A", 201), ("46494", 201), ("046494", 201),
        ("2020-068J", 409), ("25544", 409),
    ],
)  # fmt: skip
def test_an_object_id_of_ccsds_may_be_a_designator_a_number_or_a_word(api, names, object_id, status):
    """A message that does not know its object is nobody else's; one of another number or designator is refused."""
    satellite = next(names)
    created = api.post("/satellites", json={"id": satellite, "norad_id": "46494", "cospar_id": "2020-068H"})
    assert created.status_code == 201
    opm = (
        f"CCSDS_OPM_VERS = 2.0\nOBJECT_NAME = S\nOBJECT_ID = {object_id}\nCENTER_NAME = EARTH\nREF_FRAME = GCRF\n"
        "TIME_SYSTEM = UTC\nEPOCH = 2024-05-10T14:30:00\nX = 6900\nY = 0\nZ = 0\nX_DOT = 0\nY_DOT = 3\nZ_DOT = 7\n"
    )
    sent = api.post(f"/satellites/{satellite}/orbits", content=opm, headers={"content-type": "text/plain"})
    assert sent.status_code == status, sent.text


def test_a_server_message_sent_as_an_orbit_is_called_so(api, satellite):
    for content, kind in (("No GP data found", "text/plain"), ('{"error": "log in"}', "application/json")):
        answer = api.post(f"/satellites/{satellite}/orbits", content=content, headers={"content-type": kind})
        assert (answer.status_code, answer.json()["code"]) == (422, "orbit_format")
        assert "this is a server's message, not an orbit" in answer.json()["detail"]


def ended(api, job_id: str) -> dict:
    deadline = time.monotonic() + 120.0
    while (job := api.get(f"/jobs/{job_id}").json())["state"] not in ("succeeded", "failed", "cancelled"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return job


def test_an_orbit_of_another_object_that_was_forced_is_named_by_the_calibration(api, names):
    name = next(names)
    api.post("/satellites", json={"id": name, "norad_id": "25544"}).raise_for_status()
    api.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    send = {"content": tle_text(), "headers": {"content-type": "text/plain"}, "params": {"force": "true"}}
    api.post(f"/satellites/{name}/orbits", **send).raise_for_status()
    content = write_samples(simulated(SESSIONS[0], 200).samples, "csv")
    sent = api.post(f"/satellites/{name}/sessions", content=content, params={"magnetometer": "mgm"})
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [sent.json()["id"]]}).json()
    done = ended(api, job["id"])
    record = api.get(f"/parameter-sets/{done['result']['parameter_set_id']}").json()
    (warning,) = [one for one in record["warnings"] if one.startswith("orbit_of_another_object")]
    assert warning.endswith("NORAD id 46493, the satellite's is 25544")


def test_a_session_tells_which_object_of_a_launch_it_is_of(api, satellite):
    first, second = (next(line for line in tle_text().splitlines() if line.startswith(f"{kind} ")) for kind in "12")
    launch = ""
    for number, ahead_deg in ((50001, -1.0), (50002, 0.0), (50003, 1.0)):
        anomaly = (float(second[43:51]) + ahead_deg) % 360.0
        lines = (f"1 {number}{first[7:68]}", f"2 {number}{second[7:43]}{anomaly:8.4f}{second[51:68]}")
        launch += "".join(f"{line}{checksum(line)}\n" for line in lines)
    content = write_samples(simulated(SESSIONS[0], 200).samples, "csv")
    session = api.post(f"/satellites/{satellite}/sessions", content=content, params={"magnetometer": "mgm"}).json()
    answer = api.post(f"/sessions/{session['id']}/which-object", content=launch, headers=TEXT)
    assert answer.status_code == 200
    assert (answer.json()["state"], answer.json()["objects"][0]["norad_id"]) == ("told", "50002")
    assert (
        api.post("/sessions/0123456789abcdef0123456789abcdef/which-object", content=launch, headers=TEXT).status_code
        == 404
    )

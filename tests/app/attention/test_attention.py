"""What needs attention, over HTTP: each cause comes when it is so, goes when it is mended, and says what mends it."""

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import httpx2
import numpy as np
import pytest

from app.attention.causes.registry import CAUSES
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

PATIENCE_S = 300.0
PLAIN = {"content-type": "text/plain"}


def until(look: Callable[[], object]) -> object:
    """Return what ``look`` finds once it finds something."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := look()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return found


def entries(api: httpx2.Client, satellite: str, **query: str) -> dict[str, dict]:
    answer = api.get("/attention", params={"satellite": satellite, **query})
    assert answer.status_code == 200, answer.text
    return {one["code"]: one for one in answer.json()["items"]}


def press(api: httpx2.Client, entry: dict) -> httpx2.Response:
    """Do what the entry's button does."""
    action = entry["action"]
    assert action["method"] == "POST", action
    answer = api.post(action["path"].removeprefix("/api/v1"), json=action["body"])
    assert answer.is_success, answer.text
    return answer


def sent(api: httpx2.Client, satellite: str, samples: object) -> str:
    path = f"/satellites/{satellite}/sessions?magnetometer=mgm"
    content = write_samples(samples, "csv")
    return api.post(path, content=content, headers={"content-type": "text/csv"}).raise_for_status().json()["id"]


def ended(api: httpx2.Client, job_id: str) -> dict:
    return until(lambda: (job := api.get(f"/jobs/{job_id}").json())["state"] not in {"queued", "running"} and job)


@pytest.fixture(scope="module")
def flown() -> object:
    return simulated(SESSIONS[0], 1500).samples


@pytest.fixture
def orbited(api: httpx2.Client, satellite: str) -> str:
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers=PLAIN).raise_for_status()
    return satellite


def test_a_disagreeing_session_is_told_and_two_buttons_mend_it(api, orbited, flown):
    """A bias that moved by 2,000 nT: told by itself, calibrated by one button, put in force by the next."""
    first = sent(api, orbited, flown)
    none = entries(api, orbited)["no_active_set"]
    assert none["action"]["label"] == "Calibrate"
    ended(api, press(api, none).json()["id"])
    none = entries(api, orbited)["no_active_set"]
    assert none["action"]["label"] == "Activate"
    press(api, none)
    own = until(lambda: api.get(f"/sessions/{first}").json()["monitoring"])
    assert (own["grade"], own["residual_ratio"]) == ("agrees", pytest.approx(1.0, abs=0.1))
    assert "no_active_set" not in entries(api, orbited)

    moved = replace(flown, h_nt=flown.h_nt + np.array([0.0, 2000.0, 0.0]))
    second = sent(api, orbited, moved)
    told = until(lambda: entries(api, orbited).get("session_disagrees"))
    assert told["severity"] == "act"
    assert told["links"]["session_id"] == second
    assert "disagrees with the set in force" in told["text"]
    record = api.get(f"/sessions/{second}").json()["monitoring"]
    assert record["grade"] == "disagrees"
    assert record["residual_ratio"] > 4
    fleet = api.get("/fleet", params={"q": orbited}).json()["items"][0]
    assert (fleet["agreement"], fleet["residual_nt"]) == ("disagrees", record["residual_rms_nt"])
    assert fleet["state"] == "act"
    ended(api, press(api, told).json()["id"])
    again = entries(api, orbited)["session_disagrees"]
    assert again["action"]["label"] == "Activate"
    press(api, again)
    until(lambda: "session_disagrees" not in entries(api, orbited))
    until(lambda: api.get("/fleet", params={"q": orbited}).json()["items"][0]["agreement"] == "agrees")


def test_an_orbit_of_another_object_is_told_until_it_is_withdrawn(api, orbited):
    assert "orbit_other_object" not in entries(api, orbited)
    api.patch(f"/satellites/{orbited}", json={"norad_id": "12345"}).raise_for_status()
    told = entries(api, orbited)["orbit_other_object"]
    assert told["text"] == "TLE is of NORAD 46493, the satellite is 12345"
    assert told["action"] == {
        "label": "Choose orbit", "method": "GET", "path": f"/satellites/{orbited}#orbits", "body": None,
    }  # fmt: skip
    for orbit in api.get(f"/satellites/{orbited}/orbits").json()["items"]:
        gone = api.post(f"/satellites/{orbited}/orbits/{orbit['id']}/withdraw").raise_for_status().json()
        assert gone["withdrawn_at"] is not None
    assert "orbit_other_object" not in entries(api, orbited)
    api.post(f"/satellites/{orbited}/orbits/{orbit['id']}/restore").raise_for_status()
    assert "orbit_other_object" in entries(api, orbited)
    api.patch(f"/satellites/{orbited}", json={"norad_id": "046493"}).raise_for_status()
    assert "orbit_other_object" not in entries(api, orbited)


def test_one_press_takes_the_orbit_of_another_object_out_of_use_where_the_own_is_there(api, orbited):
    """A later TLE of another object, kept by force: the button withdraws it, and the satellite's own serves again."""
    own = api.get(f"/satellites/{orbited}/orbits").json()["items"][0]
    api.patch(f"/satellites/{orbited}", json={"norad_id": "46493"}).raise_for_status()
    lines = [line for line in tle_text().splitlines() if line[:2] in {"1 ", "2 "}][:2]
    changed = [_checked(line.replace("46493", "25544")) for line in lines]
    later = "\n".join([_checked(changed[0][:18] + "23001.50000000" + changed[0][32:]), changed[1]])
    path = f"/satellites/{orbited}/orbits"
    assert api.post(path, content=later, headers=PLAIN).json()["code"] == "other_object"
    wrong = api.post(f"{path}?force=true", content=later, headers=PLAIN).raise_for_status().json()["items"][0]["id"]
    told = entries(api, orbited)["orbit_other_object"]
    day = datetime.fromisoformat(own["epoch"])
    assert told["text"] == "TLE is of NORAD 25544, the satellite is 46493"
    assert told["action"]["label"] == f"Use the own orbit of {day.day} {day:%b %Y}"
    assert told["action"]["path"].endswith(f"/orbits/{wrong}/withdraw")
    press(api, told)
    assert "orbit_other_object" not in entries(api, orbited)
    (serving,) = api.get(path, params={"at": "2023-01-01T12:00:00Z"}).json()["items"]
    assert serving["id"] == own["id"]


def _checked(line: str) -> str:
    """Return a line of a TLE with its check digit made anew."""
    total = sum(int(one) if one.isdigit() else one == "-" for one in line[:68])
    return f"{line[:68]}{total % 10}"


def test_a_withdrawn_orbit_serves_no_calibration(api, orbited, flown):
    for orbit in api.get(f"/satellites/{orbited}/orbits").json()["items"]:
        api.post(f"/satellites/{orbited}/orbits/{orbit['id']}/withdraw").raise_for_status()
    session_id = sent(api, orbited, flown)
    assert entries(api, orbited)["orbit_missing"]["severity"] == "act"
    refused = api.post("/jobs", json={"kind": "calibration", "session_ids": [session_id]})
    assert refused.json()["code"] == "orbit_missing"


def test_a_failed_job_is_told_until_one_succeeds(api, orbited, flown):
    short = sent(api, orbited, flown.take(slice(0, 30)))
    job = api.post("/jobs", json={"kind": "calibration", "session_ids": [short]}).json()
    failed = ended(api, job["id"])
    assert failed["state"] == "failed"
    told = entries(api, orbited)["job_failed"]
    assert (told["severity"], told["links"]) == (
        "act", {"session_id": short, "job_id": job["id"], "parameter_set_id": None, "orbit_id": None},
    )  # fmt: skip
    assert failed["error"]["detail"] in told["text"]
    row = api.get("/fleet", params={"q": orbited}).json()["items"][0]
    assert row["last_failure"]["code"] == failed["error"]["code"]
    again = press(api, told).json()
    assert again["session_ids"] == [short]
    ended(api, again["id"])
    whole = api.post("/jobs", json={"kind": "calibration", "session_ids": [sent(api, orbited, flown)]}).json()
    assert ended(api, whole["id"])["state"] == "succeeded"
    assert "job_failed" not in entries(api, orbited)


def test_the_button_of_a_failed_job_mends_the_cause_that_its_diagnosis_names(api, orbited, flown):
    """Local time taken for UTC: an hour that no search looked for; the button looks, and the next job finds it."""
    shifted = replace(flown, t_utc=flown.t_utc + np.timedelta64(3600, "s"), q_base_gcrf=None)
    session_id = sent(api, orbited, shifted)
    body = {"kind": "calibration", "session_ids": [session_id], "time_offset": "none", "robust": "none"}
    failed = ended(api, api.post("/jobs", json=body).json()["id"])
    assert failed["error"]["diagnosis"]["findings"][0]["code"] == "clock"
    told = entries(api, orbited)["job_failed"]
    assert told["action"]["label"] == "Look for the clock"
    made = press(api, told).json()
    assert made["options"]["time_offset"] == "estimate" and made["session_ids"] == [session_id]
    after = ended(api, made["id"])
    # A second failure must not offer what has just been tried.
    if after["state"] == "failed":
        assert entries(api, orbited)["job_failed"]["action"]["label"] != "Look for the clock"


def test_limits_of_age_are_settings_of_the_satellite(api, orbited, flown):
    """Data of 2022 are old by the limit of 30 days, and not by one of 30 years; the orbit likewise."""
    sent(api, orbited, flown)
    now = entries(api, orbited)
    assert {"data_stale", "orbit_stale"} <= set(now)
    assert "limit 30 days" in now["data_stale"]["text"]
    since = datetime.fromisoformat(now["data_stale"]["since"])
    newest = datetime.fromtimestamp(flown.t_utc.max().astype("datetime64[us]").astype(int) / 1e6, UTC)
    assert since - newest == pytest.approx(timedelta(days=30), abs=timedelta(seconds=1))
    limits = {"data_stale_days": 11_000.0, "orbit_stale_days": 11_000.0, "station_silent_hours": 1e-9}
    changed = api.patch(f"/satellites/{orbited}", json=limits).raise_for_status().json()
    assert {name: changed[name] for name in limits} == limits
    later = entries(api, orbited)
    assert {"data_stale", "orbit_stale"} & set(later) == set()
    assert later["station_silent"]["severity"] == "watch"
    assert api.patch(f"/satellites/{orbited}", json={"data_stale_days": -1.0}).status_code == 422


def test_acknowledged_entries_keep_who_and_why_and_come_back_when_the_matter_changes(service, api, orbited, flown):
    """By the operator's key, in the audit; back with another session, and when its time is up."""
    sent(api, orbited, flown)
    entry = entries(api, orbited)["no_active_set"]
    made = {"scopes": ["operate", "read"], "satellites": [orbited], "name": "night shift"}
    with service.client(api.post("/keys", json=made).json()["key"]) as operator:
        seen = operator.post(f"/attention/{entry['id']}/acknowledge", json={"note": "wait for the next pass"})
        assert seen.status_code == 200, seen.text
        assert seen.json()["acknowledged"]["note"] == "wait for the next pass"
        assert seen.json()["acknowledged"]["author"] == "night shift"
        counts = operator.get("/attention").json()["counts"]
        assert counts["acknowledged"] == 1
    by = seen.json()["acknowledged"]["by"]
    (line,) = [
        one for one in api.get("/audit").json()["items"]
        if one["action"] == "attention.acknowledge" and one["satellite_id"] == orbited
    ]  # fmt: skip
    assert (line["key_id"], line["reason"]) == (by, "wait for the next pass")
    assert "no_active_set" not in entries(api, orbited, acknowledged="false")
    assert entries(api, orbited, acknowledged="true").keys() == {"no_active_set"}
    later = replace(flown, t_utc=flown.t_utc + np.timedelta64(3, "h"))
    sent(api, orbited, later)
    assert entries(api, orbited)["no_active_set"]["acknowledged"] is None
    soon = (datetime.now(UTC) + timedelta(seconds=1)).isoformat()
    api.post(f"/attention/{entry['id']}/acknowledge", json={"note": "a second", "until": soon}).raise_for_status()
    until(lambda: entries(api, orbited)["no_active_set"]["acknowledged"] is None)


def test_the_log_tells_what_is_raised_and_cleared(api, orbited, flown):
    api.patch(f"/satellites/{orbited}", json={"norad_id": "12345"}).raise_for_status()
    sent(api, orbited, flown)

    def told(kind: str) -> list[dict]:
        found = []
        with api.stream("GET", "/events", params={"after": "0", "satellite": orbited, "type": kind}) as stream:
            for line in stream.iter_lines():
                if line.startswith("data:") and "orbit_other_object" in line:
                    found.append(line)
                    break
        return found

    assert told("attention.raised")
    api.patch(f"/satellites/{orbited}", json={"norad_id": "46493"}).raise_for_status()
    assert told("attention.cleared")


def test_the_list_is_ordered_and_comes_in_parts(api, orbited, flown):
    sent(api, orbited, flown)
    whole = api.get("/attention", params={"satellite": orbited, "total": "true"}).json()
    order = {code: number for number, code in enumerate(CAUSES)}
    places = [(one["severity"] == "watch", order[one["code"]]) for one in whole["items"]]
    assert places == sorted(places)
    assert whole["total"] == len(whole["items"]) > 1
    parts, cursor = [], None
    while cursor or not parts:
        query = {"satellite": orbited, "limit": 1} | ({"cursor": cursor} if cursor else {})
        answer = api.get("/attention", params=query).json()
        parts += answer["items"]
        cursor = answer["next"]
    assert parts == whole["items"]
    assert api.get("/attention", params={"cursor": "0" * 32}).json()["code"] == "cursor"


def test_a_bound_key_sees_its_own_satellites_alone(service, api, orbited, names):
    other = next(names)
    api.post("/satellites", json={"id": other}).raise_for_status()
    api.post(f"/satellites/{other}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    entry = entries(api, other)["no_active_set"]
    with service.client(service.key("operate", "read", satellites=[orbited])) as bound:
        assert {one["satellite_id"] for one in bound.get("/attention").json()["items"]} == {orbited}
        assert {one["satellite"] for one in bound.get("/fleet").json()["items"]} == {orbited}
        refused = bound.post(f"/attention/{entry['id']}/acknowledge", json={"note": "not mine"})
        assert refused.status_code == 404
    with service.client(service.key("read")) as reader:
        assert reader.post(f"/attention/{entry['id']}/acknowledge", json={"note": "x"}).status_code == 403


def test_the_fleet_is_searched_sorted_and_counted_by_the_service(service, api, names):
    """Three satellites, one of which has telemetry: totals and facets are of the search, parts join to the whole."""
    made = [next(names) for _ in range(3)]
    for number, name in enumerate(made):
        api.post("/satellites", json={"id": name, "name": f"Lantern {name} {number}"}).raise_for_status()
        api.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    sent(api, made[1], simulated(SESSIONS[0], 60).samples)
    found = api.get("/fleet", params={"q": "lantern", "sort": "-data_until", "limit": 2}).json()
    assert (found["total"], len(found["items"]), found["items"][0]["satellite"]) == (3, 2, made[1])
    assert found["facets"]["verdict"] == {"none": 3}
    assert found["facets"]["state"] == {"act": 1, "watch": 2}
    rest = api.get("/fleet", params={"q": "lantern", "sort": "-data_until", "limit": 2, "cursor": found["next"]}).json()
    assert [one["satellite"] for one in rest["items"]] == [made[2]]
    assert api.get("/fleet", params={"q": "lantern", "state": "act"}).json()["total"] == 1
    assert api.get("/fleet", params={"q": "lantern", "sort": "nonsense"}).status_code == 422


@pytest.mark.parametrize("path", ["/attention", "/fleet"])
def test_who_has_the_list_already_is_told_so_until_it_changes(service, path, names):
    """By a key of one satellite alone: what other tests do changes nothing of it."""
    own = next(names)
    with service.client() as admin, service.client(service.key("read", satellites=[own])) as reader:
        admin.post("/satellites", json={"id": own}).raise_for_status()
        first = reader.get(path)
        tag = first.headers["etag"]
        assert first.headers["cache-control"] == "private, no-cache"
        again = reader.get(path, headers={"If-None-Match": tag})
        assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
        admin.post(f"/satellites/{own}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        changed = reader.get(path, headers={"If-None-Match": tag})
        assert changed.status_code == 200
        assert changed.headers["etag"] != tag
        assert len(changed.json()["items"]) == 1

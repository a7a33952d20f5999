"""What displays are drawn from: the same numbers as the records, and no more than the key may see."""

import time
from collections.abc import Iterator

import httpx2
import numpy as np
import pytest

from app.dashboard.schemas import HistoryFigure, SessionFigure, SetFigure

SET_FIGURES = SetFigure.__args__
SESSION_FIGURES = SessionFigure.__args__
HISTORY_FIGURES = HistoryFigure.__args__


@pytest.fixture(scope="module")
def api(service) -> Iterator[httpx2.Client]:
    with service.client() as client:
        yield client


def paths(mission) -> list[str]:
    return [
        f"/overview?satellite={mission.satellite}",
        f"/satellites/{mission.satellite}/history",
        f"/sessions/{mission.session}/summary",
        f"/sessions/{mission.session}/residual?parameter_set={mission.first}",
        f"/parameter-sets/{mission.first}/report",
        f"/figures/compare?first={mission.first}&second={mission.second}",
        *(f"/parameter-sets/{mission.first}/figures/{name}" for name in SET_FIGURES),
        *(f"/sessions/{mission.session}/figures/{name}" for name in SESSION_FIGURES),
        *(f"/satellites/{mission.satellite}/figures/{name}" for name in HISTORY_FIGURES if name != "trend"),
    ]


def test_every_display_answers_a_key_that_reads_and_nobody_else(service, mission):
    keys = {
        service.key("read", satellites=[mission.satellite]): 200,
        service.key("read", satellites=["another"]): 404,
        service.key("ingest"): 403,
        "": 401,
    }
    for key, status in keys.items():
        with service.client(key) as client:
            answers = {path: client.get(path).status_code for path in paths(mission)}
        assert answers == dict.fromkeys(answers, status)


def test_the_overview_shows_what_is_in_force(api, mission):
    deadline = time.monotonic() + 30.0  # an activation has the satellite's sessions judged, by jobs
    while any(one["state"] in {"queued", "running"} for one in api.get("/jobs?limit=1000").json()["items"]):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    (row,) = api.get(f"/overview?satellite={mission.satellite}").json()["items"]
    record = api.get(f"/parameter-sets/{mission.second}").json()
    assert row["active"]["id"] == row["newest"]["id"] == mission.second
    assert row["active"]["rms_nt"] == record["statistics"]["after"]["rms_nt"]
    assert row["last_session"]["id"] == mission.session
    assert row["jobs_waiting"] == 0


def test_the_overview_of_a_bound_key_has_no_other_satellite(service, mission):
    with service.client(service.key("read", satellites=[mission.satellite])) as client:
        rows = client.get("/overview").json()["items"]
    assert {row["satellite"] for row in rows} == {mission.satellite}


def test_a_satellite_without_a_magnetometer_is_in_the_overview(api, names):
    name = next(names)
    api.post("/satellites", json={"id": name}).raise_for_status()
    (row,) = api.get(f"/overview?satellite={name}").json()["items"]
    assert (row["magnetometer"], row["active"], row["last_session"]) == (None, None, None)


def test_the_history_is_the_records_in_flat_numbers(api, mission):
    newest, oldest = api.get(f"/satellites/{mission.satellite}/history").json()["items"]
    record = api.get(f"/parameter-sets/{mission.first}").json()
    assert [newest["id"], oldest["id"]] == [mission.second, mission.first]
    assert [oldest[f"bias_{i}_nt"] for i in (1, 2, 3)] == record["parameters"]["bias_nt"]
    assert [oldest[f"angle_{i}_error_deg"] for i in (1, 2, 3)] == record["standard_errors"]["nonorthogonality_deg"]
    assert oldest["orbit_age_days"] == max(abs(orbit["age_days"]) for orbit in record["provenance"]["orbits"])
    assert newest["replaced_id"] == mission.first
    assert (oldest["status"], newest["status"]) == ("retired", "active")


def test_the_history_comes_in_parts(api, mission):
    first = api.get(f"/satellites/{mission.satellite}/history?limit=1").json()
    rest = api.get(f"/satellites/{mission.satellite}/history?limit=1&cursor={first['next']}").json()
    assert [first["items"][0]["id"], rest["items"][0]["id"]] == [mission.second, mission.first]
    assert rest["next"] is None


def test_a_summary_spans_the_readings(api, mission):
    columns = api.get(f"/sessions/{mission.session}/samples?format=json").json()
    magnitude = np.linalg.norm(np.column_stack([columns[name] for name in ("bx", "by", "bz")]), axis=1)
    summary = api.get(f"/sessions/{mission.session}/summary").json()
    np.testing.assert_allclose(
        [summary["b_min_nt"], summary["b_max_nt"]], [magnitude.min(), magnitude.max()], rtol=1e-12
    )
    assert 0 < summary["sphere_coverage"] <= 1


def test_a_session_under_its_own_set_has_the_residual_of_the_record(api, mission):
    """The same samples, orbit and field, so equal but for the order of sums: 1e-6 relative."""
    found = api.get(f"/sessions/{mission.session}/residual?parameter_set={mission.first}").json()
    statistics = api.get(f"/parameter-sets/{mission.first}").json()["statistics"]
    assert found["samples"] == statistics["samples"]
    assert found["rms_nt"] == pytest.approx(statistics["after"]["rms_nt"], rel=1e-6)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("name", SET_FIGURES)
def test_a_figure_is_plotly_s_json_and_known_again(api, mission, name, theme):
    path = f"/parameter-sets/{mission.second}/figures/{name}?theme={theme}"
    answer = api.get(path)
    assert set(answer.json()) == {"data", "layout"}
    again = api.get(path, headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_an_unknown_figure_or_look_is_refused(api, mission):
    assert api.get(f"/parameter-sets/{mission.first}/figures/pie").status_code == 422
    assert api.get(f"/parameter-sets/{mission.first}/figures/map?theme=pink").status_code == 422


def test_the_report_may_reach_nothing(api, mission):
    answer = api.get(f"/parameter-sets/{mission.first}/report")
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["content-security-policy"].startswith("default-src 'none'")
    assert mission.first in answer.text
    assert "plate-map" in answer.text


def test_a_parameter_set_in_a_list_takes_under_500_bytes_on_request(api, mission):
    query = {"satellite": mission.satellite, "view": "summary", "total": "true"}
    answer = api.get("/parameter-sets", params=query)
    items = answer.json()["items"]
    assert {mission.first, mission.second} <= {one["id"] for one in items}
    assert answer.json()["total"] == len(items)
    assert len(answer.content) < 500 * len(items)
    for one in items:
        full = api.get(f"/parameter-sets/{one['id']}").json()
        assert one["rms_nt"] == full["statistics"]["after"]["rms_nt"]
        assert (one["grade"], one["status"]) == (full["verdict"]["grade"], full["status"])
    assert answer.headers["etag"] != api.get("/parameter-sets", params=query | {"view": "full"}).headers["etag"]


def test_a_row_of_the_history_says_what_was_asked_for_beside_the_defaults(api, mission):
    body = {"kind": "calibration", "session_ids": [mission.session], "robust": "tukey", "max_orbit_age_days": 9}
    job = api.post("/jobs", json=body).json()
    deadline = time.monotonic() + 60.0
    while job["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline
        time.sleep(0.1)
        job = api.get(f"/jobs/{job['id']}").json()
    rows = {one["id"]: one for one in api.get(f"/satellites/{mission.satellite}/history").json()["items"]}
    asked = rows[job["result"]["parameter_set_id"]]
    assert (asked["session_ids"], asked["options"]) == ([mission.session], "robust tukey, max_orbit_age_days 9.0")
    assert rows[mission.first]["options"] == ""

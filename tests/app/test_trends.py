"""Trends, series and figures over HTTP and on the command line: the core's numbers, and refusals by name."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import datetime

import httpx2
import numpy as np
import pyarrow as pa
import pytest

from app.cli.main import run
from app.jobs.tables import Job
from app.parameter_sets.tables import ParameterSet
from app.storage.database import new_id, utc_now
from magcal_core.calibration.sessions.trend import trend
from magcal_core.telemetry.iso_times import parse_iso_ns
from tests.magcal_core.calibration.sessions.histories import history, nine

SENSOR = {"satellite_id": "trending", "magnetometer_id": "mgm"}
PATH = "/satellites/trending/magnetometers/mgm/trend"


def keep(session, place: dict, record: dict) -> str:
    """Store a parameter set as a worker would, with no telemetry behind it; return its id."""
    job, now = new_id(), utc_now()
    plain = {"priority": 0, "progress": 1.0, "attempts": 1, "lost_attempts": 0, "cancel_requested": False}
    session.add(Job(id=job, kind="calibration", state="succeeded", request={}, created_at=now, **plain, **place))
    session.flush()
    row = ParameterSet(
        id=new_id(),
        job_id=job,
        status=record["status"],
        grade=record["verdict"]["grade"],
        method=record["method"],
        data_from=datetime.fromisoformat(record["data_from"]),
        data_until=datetime.fromisoformat(record["data_until"]),
        record=record,
        residuals_sha256="0" * 64,
        created_at=now,
        **place,
    )
    session.add(row)
    session.flush()
    return row.id


@pytest.fixture(scope="module")
def stored(service) -> Iterator[tuple[httpx2.Client, list[dict]]]:
    """A client, and the sets of a magnetometer with a jump, under the ids that the service gave them."""
    sets = history(21, 9, walk_nt=60.0, jump=(5, (700.0, -200.0, 100.0))).sets
    with service.client() as api:
        api.post("/satellites", json={"id": "trending"}).raise_for_status()
        for name in ("mgm", "bare", "broken"):
            api.post("/satellites/trending/magnetometers", json={"id": name, "unit": "nT"}).raise_for_status()
        with service.database.write() as session:
            for one in sets:
                one["id"] = keep(session, SENSOR, one)
            for one in history(22, 4).sets:
                keep(session, SENSOR | {"magnetometer_id": "broken"}, one | {"covariance": (-np.eye(9)).tolist()})
            for one in history(23, 2).sets:
                keep(session, SENSOR | {"magnetometer_id": "bare"}, one)
        sets = [one | {"satellite": "trending"} for one in sets]
        yield api, sets


def test_the_trend_is_that_of_the_core(stored):
    api, sets = stored
    found, core = api.get(PATH).json(), trend(sets).to_dict()
    np.testing.assert_allclose(nine(found["parameters"]), nine(core["parameters"]), rtol=1e-12)
    np.testing.assert_allclose(nine(found["standard_errors"]), nine(core["standard_errors"]), rtol=1e-12)
    assert (found["satellite"], found["magnetometer"], found["sets"]) == ("trending", "mgm", 9)
    (jump,) = found["jumps"]
    assert (jump["from_set"], jump["until_set"]) == (sets[4]["id"], sets[5]["id"])
    assert jump["from"] < jump["until"]
    assert found["life"]["parameter_set_id"] == sets[-1]["id"]
    assert found["life"]["text"].startswith("good for ")


def test_share_and_field_change_the_life_and_nothing_of_the_parameters(stored):
    api, _ = stored
    tight, wide = (api.get(PATH, params={"share": share}).json() for share in (0.004, 0.03))
    assert tight["life"]["days"] < wide["life"]["days"]
    assert tight["parameters"] == wide["parameters"]
    assert api.get(PATH, params={"field_nt": 60_000}).json()["field_error_nt"] > wide["field_error_nt"]


def test_a_span_of_data_is_a_trend_of_its_own(stored):
    api, sets = stored
    found = api.get(PATH, params={"until": sets[4]["data_until"]}).json()
    assert (found["sets"], found["jumps"]) == (5, [])
    found = api.get(PATH, params={"since": sets[5]["data_from"]}).json()
    assert found["sets"] == 4


@pytest.mark.parametrize("form", ["json", "csv", "ndjson", "parquet"])
def test_the_series_ends_at_the_record(stored, form):
    api, _ = stored
    record = api.get(PATH).json()
    answer = api.get(f"{PATH}/series", params={"format": form, "points": 50})
    assert answer.status_code == 200
    if form == "parquet":
        rows = pa.parquet.read_table(pa.BufferReader(answer.content)).to_pydict()
        assert len(rows["time"]) == 50
        last = {name: column[-1] for name, column in rows.items()}
    elif form == "json":
        last = {name: column[-1] for name, column in answer.json().items()}
    elif form == "ndjson":
        last = json.loads(answer.text.splitlines()[-1])
    else:
        names, *_, end = answer.text.splitlines()
        last = dict(zip(names.split(","), end.split(","), strict=True))
    assert list(last)[:2] == ["time", "bias_1_nt"]
    assert len(last) == 20
    assert float(last["bias_1_nt"]) == pytest.approx(record["parameters"]["bias_nt"][0], rel=1e-9)
    assert float(last["angle_3_error_deg"]) == pytest.approx(
        record["standard_errors"]["nonorthogonality_deg"][2], rel=1e-6
    )
    assert float(last["field_error_nt"]) == pytest.approx(record["field_error_nt"], rel=1e-6)


def test_the_series_accepts_bounds_and_media_types(stored):
    api, sets = stored
    bounds = {"from": sets[2]["data_from"], "until": sets[3]["data_until"], "points": 3}
    answer = api.get(f"{PATH}/series", params=bounds, headers={"accept": "text/csv"})
    times = [line.split(",")[0] for line in answer.text.splitlines()[1:]]
    assert [parse_iso_ns(one) for one in (times[0], times[-1])] == [
        parse_iso_ns(bounds["from"]),
        parse_iso_ns(bounds["until"]),
    ]
    assert api.get(f"{PATH}/series", params={"points": 5001}).status_code == 422


REFUSED = [
    ("/satellites/nowhere/magnetometers/mgm/trend", {}, 404, "not_found"),
    ("/satellites/trending/magnetometers/nothing/trend", {}, 404, "not_found"),
    ("/satellites/trending/magnetometers/bare/trend", {"at": "2090-01-01T00:00:00Z"}, 409, "too_few_sets"),
    ("/satellites/trending/magnetometers/broken/trend", {}, 422, "option"),
    (PATH, {"at": "2090-01-01T00:00:00Z"}, 422, "beyond_history"),
    (PATH, {"at": "1990-01-01T00:00:00Z"}, 422, "beyond_history"),
    (PATH, {"at": "yesterday"}, 422, "time"),
    (PATH, {"since": "then"}, 422, "time"),
    (PATH, {"share": "0"}, 422, "option"),
    (f"{PATH}/series", {"from": "then"}, 422, "time"),
    (f"{PATH}/series", {"until": "2090-01-01T00:00:00Z"}, 422, "beyond_history"),
]


@pytest.mark.parametrize(("path", "query", "status", "code"), REFUSED)
def test_what_cannot_be_answered_is_refused_by_name(stored, path, query, status, code):
    api, _ = stored
    answer = api.get(path, params=query)
    assert (answer.status_code, answer.json()["code"]) == (status, code)


def test_a_trend_takes_a_key_that_reads_and_reaches(service, stored):
    keys = {
        service.key("read", satellites=["trending"]): 200,
        service.key("read", satellites=["another"]): 404,
        service.key("ingest"): 403,
        "": 401,
    }
    for key, status in keys.items():
        with service.client(key) as client:
            for path in (PATH, f"{PATH}/series", "/satellites/trending/figures/trend?magnetometer=mgm"):
                assert client.get(path).status_code == status


def test_the_figure_has_nine_panels_the_bound_with_its_limit_and_the_jump_hatched(stored):
    api, _ = stored
    made = api.get("/satellites/trending/figures/trend", params={"magnetometer": "mgm", "theme": "dark"}).json()
    places = {trace.get("yaxis") for trace in made["data"]}
    assert len(places) == 10
    assert sum("fillpattern" in trace for trace in made["data"]) == 3
    assert [trace["name"] for trace in made["data"] if trace["yaxis"] == "y10"] == ["bound, 95 %", "limit"]
    assert any("good for" in note["text"] for note in made["layout"]["annotations"])
    unnamed = api.get("/satellites/trending/figures/trend")
    assert (unnamed.status_code, unnamed.json()["code"]) == (422, "option")


@pytest.fixture
def files(tmp_path, stored) -> list[str]:
    """The sets as a list, as what the service lists, and one by one."""
    _, sets = stored
    listed, items, one = (tmp_path / name for name in ("list.json", "items.json", "one.json"))
    listed.write_text(json.dumps(sets[:4]), encoding="utf-8")
    items.write_text(json.dumps({"items": sets[4:8], "next": None}), encoding="utf-8")
    one.write_text(json.dumps(sets[8]), encoding="utf-8")
    return [str(listed), str(items), str(one)]


def ran(capsys, *argv: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        run(["trend", *argv])
    out, err = capsys.readouterr()
    return int(ended.value.code or 0), out, err


def test_the_command_reads_files_of_every_kind_and_says_what_the_core_says(capsys, files, stored, tmp_path):
    _, sets = stored
    series = tmp_path / "series.csv"
    status, out, _ = ran(capsys, *files, "--json", "--series", str(series))
    assert status == 0
    assert json.loads(out) == json.loads(json.dumps(trend(sets).to_dict()))
    assert len(series.read_text(encoding="utf-8").splitlines()) == 201
    status, out, _ = ran(capsys, *files)
    assert status == 0
    assert "good for" in out
    assert "jump: bias_nt changed by" in out


def test_the_command_fails_with_the_code_and_with_2_for_a_time_that_is_none(capsys, files):
    status, _, err = ran(capsys, files[2])
    assert (status, err.split(": ")[1]) == (1, "too_few_sets")
    status, _, err = ran(capsys, *files, "--at", "2090-01-01T00:00:00Z")
    assert (status, err.split(": ")[1]) == (1, "beyond_history")
    assert ran(capsys, *files, "--at", "yesterday")[0] == 2


def test_a_rollout_says_what_changes_today_and_at_the_end_of_the_life(stored):
    """The set before the last one against the last, which is in force: 40,000 nT of field, errors of tens of nT."""
    api, sets = stored
    found = api.get(f"/parameter-sets/{sets[7]['id']}/rollout").json()
    assert (found["parameter_set_id"], found["active_id"]) == (sets[7]["id"], sets[8]["id"])
    assert found["field_change_nt"] < 6.0 * found["field_change_error_nt"]
    assert found["today"]["set_nt"] > 0.0
    assert found["at_end"]["set_nt"] > found["today"]["set_nt"]
    assert found["at_end"]["active_nt"] > found["today"]["active_nt"]
    assert found["life"]["parameter_set_id"] == sets[7]["id"]
    assert found["text"].startswith("the corrected field changes by ")
    old = api.get(f"/parameter-sets/{sets[0]['id']}/rollout").json()
    assert old["today"]["set_nt"] > 500.0
    assert "no longer good" in old["text"]
    own = api.get(f"/parameter-sets/{sets[8]['id']}/rollout").json()
    assert (own["active_id"], own["field_change_nt"]) == (None, None)


def test_a_rollout_without_a_trend_still_says_what_changes(stored):
    api, _ = stored
    (one, *_) = api.get("/parameter-sets", params={"satellite": "trending", "magnetometer": "bare"}).json()["items"]
    found = api.get(f"/parameter-sets/{one['id']}/rollout").json()
    assert found["life"] is None
    assert "cannot be told: 2 parameter sets count" in found["text"]

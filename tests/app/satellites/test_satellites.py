"""Satellites and magnetometers over HTTP."""

import httpx2


def test_a_new_satellite_is_answered_with_201_and_can_be_read_back(api, names):
    name = next(names)
    made = api.post("/satellites", json={"id": name, "name": "DEKART", "norad_id": "46493", "cospar_id": "2020-068H"})
    assert made.status_code == 201
    assert made.headers["location"] == f"/api/v1/satellites/{name}"
    assert api.get(f"/satellites/{name}").json() == made.json()
    assert made.json()["created_at"].endswith("Z")


def test_the_same_satellite_twice_is_a_conflict(api, satellite):
    again = api.post("/satellites", json={"id": satellite})
    assert (again.status_code, again.json()["code"]) == (409, "conflict")
    assert again.headers["content-type"] == "application/problem+json"


def test_a_norad_id_may_be_sent_as_a_number(api, names):
    made = api.post("/satellites", json={"id": next(names), "norad_id": 46493})
    assert made.json()["norad_id"] == "46493"


def test_a_satellite_that_is_not_there_answers_404(api):
    assert api.get("/satellites/nowhere").json()["code"] == "not_found"


def test_an_unknown_member_is_refused_by_name(api, names):
    answer = api.post("/satellites", json={"id": next(names), "created_by": "me"})
    assert (answer.status_code, answer.json()["code"]) == (422, "extra_forbidden")
    assert answer.json()["errors"] == [{"where": "body.created_by", "why": "nothing of this name is known here"}]


def test_names_with_control_characters_are_refused_without_echo(api, names):
    answer = api.post("/satellites", json={"id": next(names), "name": "evil\u202ename"})
    assert answer.status_code == 422
    assert "evil" not in answer.text


def test_a_magnetometer_keeps_unit_columns_and_axes(api, satellite):
    body = {
        "id": "ext",
        "unit": "mG",
        "noise_nt": 80.0,
        "columns": {"time": "ts", "bx": "extmag_0"},
        "axis_map": ["y", "-x", "z"],
        "range_nt": 200_000,
        "policy": {"calibrate": True, "method": "scalar"},
    }
    made = api.post(f"/satellites/{satellite}/magnetometers", json=body)
    assert made.status_code == 201
    kept = api.get(f"/satellites/{satellite}/magnetometers/ext").json()
    assert {name: kept[name] for name in body if name != "policy"} == {n: v for n, v in body.items() if n != "policy"}
    assert kept["policy"]["method"] == "scalar"
    assert api.post(f"/satellites/{satellite}/magnetometers", json=body).status_code == 409


def test_a_magnetometer_without_a_unit_or_with_a_doubled_axis_is_refused(api, satellite):
    for body in ({"id": "a"}, {"id": "a", "unit": "tesla"}, {"id": "a", "unit": "nT", "axis_map": ["x", "-x", "z"]}):
        assert api.post(f"/satellites/{satellite}/magnetometers", json=body).status_code == 422


def test_lists_come_in_parts_that_do_not_shift(api, names):
    made = [next(names) for _ in range(5)]
    for name in made:
        api.post("/satellites", json={"id": name})
    first = api.get("/satellites", params={"limit": 2}).json()
    api.post("/satellites", json={"id": next(names)})
    second = api.get("/satellites", params={"limit": 2, "cursor": first["next"]}).json()
    assert [one["id"] for one in first["items"] + second["items"]] == made[:0:-1]


def test_a_cursor_that_was_not_given_is_refused(api):
    for cursor in ("", "x", "W10", "WzEsMl0", "bnVsbA", "\u00e9"):
        assert api.get("/satellites", params={"cursor": cursor}).json()["code"] == "cursor", cursor


def test_an_unknown_query_parameter_is_refused(api):
    assert api.get("/satellites", params={"sort": "name; drop table satellite"}).status_code == 422


def test_not_a_number_and_doubled_keys_are_not_json(api: httpx2.Client, satellite: str):
    for text in ('{"id": "m", "unit": "nT", "noise_nt": NaN}', '{"id": "m", "id": "n", "unit": "nT"}', "[" * 100_000):
        answer = api.post(
            f"/satellites/{satellite}/magnetometers", content=text, headers={"content-type": "application/json"}
        )
        assert (answer.status_code, answer.json()["code"]) == (400, "json"), text[:40]

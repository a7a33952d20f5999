"""Keys, scopes and the audit trail over HTTP."""

from datetime import UTC, datetime, timedelta

import pytest


def test_a_new_key_is_shown_once_and_its_secret_is_not_kept(service, api):
    made = api.post("/keys", json={"scopes": ["read", "ingest"], "satellites": ["a", "b"], "name": "station"}).json()
    assert made["key"].startswith(f"mgc_{made['id']}_")
    assert (made["scopes"], made["satellites"]) == (["ingest", "read"], ["a", "b"])
    secret = made["key"].split("_", 2)[2]
    listed = api.get("/keys").text
    assert made["id"] in listed
    assert secret not in listed
    files = b"".join(path.read_bytes() for path in service.settings.data_dir.glob("magcal.db*"))
    assert made["id"].encode() in files
    assert secret.encode() not in files


@pytest.mark.parametrize("key", ["nonsense", "mgc_0123456789abcdef_" + "A" * 43, "mgc_zz_" + "A" * 43])
def test_every_wrong_key_gets_the_same_answer(service, key):
    with service.client("") as nobody:
        expected = nobody.get("/satellites")
        answer = nobody.get("/satellites", headers={"authorization": f"Bearer {key}"})
    assert (answer.status_code, answer.content) == (401, expected.content)
    assert answer.headers["www-authenticate"] == 'Bearer realm="magcal"'


def test_a_right_id_with_a_wrong_secret_is_refused(service, api):
    key = api.post("/keys", json={"scopes": ["read"]}).json()["key"]
    with service.client(key[:-1] + ("A" if key[-1] != "A" else "B")) as stranger:
        assert stranger.get("/satellites").status_code == 401


def test_a_key_without_the_scope_is_told_which_one_it_lacks(service):
    with service.client(service.key("read")) as reader:
        answer = reader.post("/satellites", json={"id": "x"})
    assert (answer.status_code, answer.json()["code"]) == (403, "scope_required")
    assert "operate" in answer.json()["detail"]


def test_admin_includes_the_other_scopes_and_no_other_does(service):
    with service.client(service.key("operate")) as operator:
        assert operator.get("/satellites").status_code == 403
    with service.client(service.key("admin")) as admin:
        assert admin.get("/satellites").status_code == 200


def test_a_revoked_key_is_refused_at_the_next_request_and_stays_listed(service, api):
    made = api.post("/keys", json={"scopes": ["read"]}).json()
    with service.client(made["key"]) as reader:
        assert reader.get("/satellites").status_code == 200
        assert api.post(f"/keys/{made['id']}/revoke").json()["revoked_at"] is not None
        assert reader.get("/satellites").status_code == 401
    assert made["id"] in api.get("/keys").text


def test_an_expired_key_is_refused(service, api):
    past = (datetime.now(UTC) - timedelta(seconds=1)).isoformat()
    made = api.post("/keys", json={"scopes": ["read"], "expires_at": past}).json()
    with service.client(made["key"]) as reader:
        assert reader.get("/satellites").status_code == 401


def test_a_bound_key_cannot_make_keys(service):
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        assert bound.post("/keys", json={"scopes": ["admin"]}).status_code == 403


def test_another_satellite_is_not_there_for_a_bound_key(service, api, satellite):
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        assert bound.get(f"/satellites/{satellite}").content == bound.get("/satellites/nowhere").content
        assert bound.get("/satellites").json()["items"] == []
        assert bound.post("/satellites", json={"id": satellite}).status_code == 404


def test_who_did_what_can_be_read(service, api, satellite):
    events = api.get("/audit").json()["items"]
    made = next(one for one in events if one["action"] == "satellite.create" and one["subject"] == satellite)
    assert made["key_id"] == service.admin_key.split("_")[1]
    assert made["address"] == "127.0.0.1"
    assert made["request_id"]


def test_twenty_wrong_keys_a_minute_are_enough(new_service):
    service = new_service(auth_failures_per_minute=20)
    with service.client("nonsense") as guesser, service.client() as admin:
        answers = [guesser.get("/satellites").status_code for _ in range(22)]
        assert answers == [401] * 20 + [429] * 2
        assert guesser.get("/satellites").headers["retry-after"] == "60"
        assert admin.get("/satellites").status_code == 200

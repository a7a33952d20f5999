"""What the service remembers of a right key, and for how long (A5)."""

from __future__ import annotations

import time

from app.http.entity_tags import TRUSTED_S


def test_a_key_that_was_just_right_is_refused_by_the_process_that_revokes_it_at_its_next_request(new_service):
    service = new_service()
    with service.client() as admin:
        made = admin.post("/keys", json={"scopes": ["read"]}).json()
        with service.client(made["key"]) as reader:
            assert reader.get("/satellites").status_code == 200
            admin.post(f"/keys/{made['id']}/revoke").raise_for_status()
            assert reader.get("/satellites").status_code == 401


def test_a_key_revoked_behind_the_service_s_back_is_refused_within_a_second(new_service):
    """As another process does it: in the database alone."""
    service = new_service()
    assert TRUSTED_S < 1.0
    made = service.key("read")
    with service.client(made) as reader:
        assert reader.get("/satellites").status_code == 200
        with service.database.engine.begin() as connection:
            connection.exec_driver_sql(
                "UPDATE api_key SET revoked_at = '2020-01-01 00:00:00.000000' WHERE id = ?", (made.split("_")[1],)
            )
        time.sleep(TRUSTED_S + 0.1)
        assert reader.get("/satellites").status_code == 401


def test_the_right_half_of_a_known_key_buys_nothing(new_service):
    service = new_service()
    made = service.key("read")
    with service.client(made) as reader, service.client(made[:-1] + ("A" if made[-1] != "A" else "B")) as guessing:
        assert reader.get("/satellites").status_code == 200
        assert guessing.get("/satellites").status_code == 401


def test_a_key_that_is_refused_for_its_scope_is_looked_up_each_time_as_a_wrong_one_is(new_service):
    """Else its refusal would be the quicker one (A7): revoked behind the service's back, it is refused at once."""
    service = new_service()
    made = service.key("ingest")
    with service.client(made) as station:
        assert station.get("/satellites").status_code == 403
        with service.database.engine.begin() as connection:
            connection.exec_driver_sql(
                "UPDATE api_key SET revoked_at = '2020-01-01 00:00:00.000000' WHERE id = ?", (made.split("_")[1],)
            )
        assert station.get("/satellites").status_code == 401

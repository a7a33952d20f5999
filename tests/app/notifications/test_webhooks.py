"""Webhooks over HTTP: a receiver gets everything, signed, at least once and in order; and nothing goes elsewhere."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path

import httpx2
import pytest
from sqlalchemy import update
from standardwebhooks import Webhook as Verifier
from standardwebhooks import WebhookVerificationError

from app.access.first_key import make_first_key
from app.notifications.tables import Delivery
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade

ALL = [
    "session.received", "job.ended", "parameter_set.created", "parameter_set.activated",
    "attention.raised", "attention.cleared",
]  # fmt: skip
CSV = b"time,bx,by,bz,ref_b\n" + b"".join(
    f"2026-01-01T00:{n // 60:02d}:{n % 60:02d}Z,{20000 + n},{n * 7 % 50},2,20000\n".encode() for n in range(60)
)


def hook(api: httpx2.Client, url: str, events: list[str] | None = None) -> dict:
    answer = api.post("/webhooks", json={"url": url, "events": events or ["attention.raised"]})
    assert answer.status_code == 201, answer.text
    return answer.json()


def asked_for(receiver) -> list[dict]:
    """Return what was told, without the monitoring that a set in force brings by itself, at a time of its own."""
    return [one for one in receiver.bodies() if one["data"].get("kind") != "monitoring"]


@pytest.fixture
def open_service(new_service):
    return new_service(webhook_hosts="127.0.0.1")


def test_what_happens_to_a_magnetometer_is_told_signed_and_in_order(new_service, receiver, until):
    """The whole way of a session over HTTP: received, calibrated, activated, taken back."""
    from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
    from magcal_core.telemetry import write_samples

    service = new_service(webhook_hosts="127.0.0.1", workers=1)
    with service.client() as api:
        made = hook(api, receiver.url, ALL[:4])
        assert made["secret"].startswith("whsec_")
        assert "secret" not in api.get("/webhooks").json()["items"][0]
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT", "policy": {"method": "scalar"}})
        api.post("/satellites/a/orbits", content=tle_text(), headers={"content-type": "text/plain"}).raise_for_status()
        telemetry = write_samples(simulated(SESSIONS[0], 300).samples, "csv")
        where = {"params": {"magnetometer": "m"}, "headers": {"content-type": "text/csv"}}
        sent = api.post("/satellites/a/sessions", content=telemetry, **where).json()
        until(lambda: len(asked_for(receiver)) == 3, 240.0)
        found = asked_for(receiver)[1]["data"]["parameter_set_id"]
        api.post(f"/parameter-sets/{found}/activate", params={"force": "true", "reason": "tried"}).raise_for_status()
        api.post(f"/parameter-sets/{found}/rollback").raise_for_status()
        assert api.post("/satellites/a/sessions", content=telemetry, **where).status_code == 200
        until(lambda: len(asked_for(receiver)) == 5)
    receiver.verify(made["secret"])
    bodies = asked_for(receiver)
    assert [one["type"] for one in bodies] == [
        "session.received", "parameter_set.created", "job.ended", "parameter_set.activated", "parameter_set.activated",
    ]  # fmt: skip
    assert all(list(one) == ["type", "timestamp", "data"] for one in bodies)
    assert bodies[0]["data"]["session_id"] == sent["id"]
    assert (bodies[2]["data"]["state"], bodies[2]["data"]["result"]) == ("succeeded", {"parameter_set_id": found})
    forces = [(one["data"]["parameter_set_id"], one["data"]["previous_parameter_set_id"]) for one in bodies[3:]]
    assert forces == [(found, None), (None, found)]
    headers, body = receiver.received[0]
    with pytest.raises(WebhookVerificationError):
        Verifier(made["secret"]).verify(body + b" ", headers)


def test_a_receiver_that_is_down_gets_everything_once_it_is_back_in_order(open_service, receiver, happen, until):
    """Sixty events of three magnetometers while nobody listens; then all of them, each once, in each one's order."""
    with open_service.client() as api:
        made = hook(api, receiver.url)
        receiver.down()
        for count in range(20):
            for magnetometer in ("m1", "m2", "m3"):
                happen(open_service.database, f"{magnetometer}-{count}", magnetometer)
        until(lambda: api.get("/webhooks").json()["items"][0]["is_failing"])
        time.sleep(1.5)
        receiver.up()
        until(lambda: len(receiver.received) == 60)
        until(lambda: not api.get(f"/webhooks/{made['id']}/deliveries?state=pending").json()["items"])
        assert not api.get("/webhooks").json()["items"][0]["is_failing"]
    receiver.verify(made["secret"])
    for magnetometer in ("m1", "m2", "m3"):
        assert receiver.causes(magnetometer) == [f"{magnetometer}-{count}" for count in range(20)]
    assert len({headers["webhook-id"] for headers, _ in receiver.received}) == 60


def test_a_refused_event_holds_back_its_magnetometer_alone(open_service, receiver, happen, until):
    refusals = [3]

    def answer(body):
        if body["data"]["cause"] == "a1" and refusals[0]:
            refusals[0] -= 1
            return 500, {}
        return 200, {}

    receiver.answer = answer
    with open_service.client() as api:
        made = hook(api, receiver.url)
        for cause, magnetometer in (("a1", "a"), ("a2", "a"), ("b1", "b"), ("b2", "b")):
            happen(open_service.database, cause, magnetometer)
        until(lambda: receiver.causes().count("a2") == 1)
        until(lambda: not api.get(f"/webhooks/{made['id']}/deliveries?state=pending").json()["items"])
        listed = api.get(f"/webhooks/{made['id']}/deliveries").json()["items"]
    assert receiver.causes("a") == ["a1"] * 4 + ["a2"]
    assert receiver.causes("b") == ["b1", "b2"]
    assert {one["attempts"] for one in listed} == {4, 1}
    same = [headers for headers, body in receiver.received if b'"a1"' in body]
    assert len({one["webhook-id"] for one in same}) == 1
    receiver.verify(made["secret"])


def test_what_is_refused_for_too_long_is_parked_with_the_reason_and_can_be_sent_again(
    open_service, receiver, happen, until
):
    receiver.answer = lambda _body: (503, {"retry-after": "1"})
    database = open_service.database
    with open_service.client() as api:
        made = hook(api, receiver.url)
        listing = f"/webhooks/{made['id']}/deliveries"
        happen(database, "first")
        until(lambda: receiver.received)
        until(lambda: api.get(listing).json()["items"][0]["attempts"])
        with database.write() as session:  # a day goes by
            session.execute(update(Delivery).values(first_attempt_at=utc_now() - timedelta(hours=25)))
        happen(database, "second")
        until(lambda: api.get(listing, params={"state": "parked"}).json()["items"])
        (parked,) = api.get(listing, params={"state": "parked"}).json()["items"]
        assert (parked["status"], "503" in parked["reason"]) == (503, True)
        until(lambda: "second" in receiver.causes())
        receiver.answer = lambda _body: (200, {})
        again = api.post(f"{listing}/{parked['id']}/replay")
        assert (again.status_code, again.json()["state"], again.json()["attempts"]) == (202, "pending", 0)
        until(lambda: not api.get(listing, params={"state": "pending"}).json()["items"])
        assert {one["state"] for one in api.get(listing).json()["items"]} == {"delivered"}
        assert api.post(f"{listing}/{'0' * 32}/replay").status_code == 404
    assert receiver.causes()[-2:] == ["first", "second"]
    receiver.verify(made["secret"])


def test_a_redirect_is_not_followed_and_gone_means_gone(open_service, receiver, happen, until):
    """The receiver would take what it redirects to itself."""
    receiver.answer = lambda _body: (307, {"location": receiver.url})
    with open_service.client() as api:
        listing = f"/webhooks/{hook(api, receiver.url)['id']}/deliveries"
        happen(open_service.database, "one")
        until(lambda: api.get(listing).json()["items"] and api.get(listing).json()["items"][0]["attempts"])
        assert "redirect" in api.get(listing).json()["items"][0]["reason"]
        receiver.answer = lambda _body: (410, {})
        until(lambda: api.get(listing).json()["items"][0]["state"] == "parked")


def test_a_webhook_that_is_deleted_is_told_no_more_and_one_that_is_made_hears_of_no_past(
    open_service, receiver, happen, until
):
    with open_service.client() as api:
        first = hook(api, receiver.url)
        happen(open_service.database, "one")
        until(lambda: receiver.causes() == ["one"])
        assert api.delete(f"/webhooks/{first['id']}").status_code == 204
        assert api.delete(f"/webhooks/{first['id']}").status_code == 404
        happen(open_service.database, "two")
        second = hook(api, receiver.url)
        happen(open_service.database, "three")
        until(lambda: "three" in receiver.causes())
        assert receiver.causes() == ["one", "three"]
        assert [one["id"] for one in api.get("/webhooks").json()["items"]] == [second["id"]]


@pytest.mark.parametrize(
    ("url", "code"),
    [
        ("https://hooks.example.org/x", "webhook_host"),
        ("http://127.0.0.2/", "webhook_host"),
        ("http://[::1]/", "webhook_host"),
        ("http://127.0.0.1@hooks.example.org/", "webhook_url"),
        ("http://user:pass@127.0.0.1/", "webhook_url"),
        ("ftp://127.0.0.1/", "webhook_url"),
        ("http://127.0.0.1:99999/", "webhook_url"),
        ("http://127.0.0.1/#x", "webhook_url"),
        ("http://127.0.0.1/ x", "webhook_url"),
        ("127.0.0.1", "webhook_url"),
    ],
)
def test_only_listed_hosts_may_be_registered(api, url, code):
    answer = api.post("/webhooks", json={"url": url, "events": ["job.ended"]})
    assert (answer.status_code, answer.json()["code"]) == (422, code)


def test_events_must_be_known_and_there_must_be_some(api):
    for events in ([], ["job.begun"], "job.ended"):
        assert api.post("/webhooks", json={"url": "http://127.0.0.1/", "events": events}).status_code == 422


def test_with_default_settings_none_may_be_registered(new_service):
    with new_service().client() as api:
        answer = api.post("/webhooks", json={"url": "http://127.0.0.1/", "events": ["job.ended"]})
    assert (answer.status_code, answer.json()["code"]) == (422, "webhook_host")


@pytest.mark.postgres
def test_of_several_servers_one_delivers_and_another_takes_over(new_service, postgres_url, receiver, happen, until):
    """Two servers over one PostgreSQL: each event once, while both run and after the one that delivered has stopped."""
    first, second = (new_service(webhook_hosts="127.0.0.1", database_url=postgres_url) for _ in range(2))
    with second.client(first.admin_key) as api:
        made = hook(api, receiver.url)
    for count in range(10):
        happen((first, second)[count % 2].database, str(count))
    until(lambda: len(receiver.received) == 10)
    first.server.should_exit = True
    for count in range(10, 20):
        happen(second.database, str(count))
    until(lambda: len(receiver.received) == 20)
    receiver.verify(made["secret"])
    assert receiver.causes() == [str(count) for count in range(20)]


def test_a_server_that_is_killed_in_the_middle_loses_nothing(tmp_path: Path, receiver, happen, until):
    """SIGKILL while deliveries wait and are on their way: the next process sends what is left, in order."""
    settings = Settings(data_dir=tmp_path, webhook_hosts="127.0.0.1")
    database = Database(settings)
    upgrade(database, settings)
    key = make_first_key(database, settings)
    environment = os.environ | {
        "MAGCAL_DATA_DIR": str(tmp_path), "MAGCAL_WEBHOOK_HOSTS": "127.0.0.1", "MAGCAL_MIN_FREE_MB": "0",
        "MAGCAL_WORKERS": "0",
    }  # fmt: skip

    def serve() -> tuple[subprocess.Popen[bytes], str]:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        command = [Path(sys.executable).with_name("magcal"), "serve", "--port", str(port)]
        running = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        url = f"http://127.0.0.1:{port}"
        until(lambda: is_up(url), 60.0)
        return running, url

    running, url = serve()
    with httpx2.Client(base_url=f"{url}/api/v1", headers={"authorization": f"Bearer {key}"}, trust_env=False) as api:
        made = hook(api, receiver.url)
    receiver.answer = lambda _body: (time.sleep(0.05), (200, {}))[1]
    for count in range(30):
        happen(database, str(count))
    until(lambda: len(receiver.received) >= 5)
    running.send_signal(signal.SIGKILL)
    running.wait()
    had = len(receiver.received)
    assert had < 30
    for count in range(30, 35):
        happen(database, str(count))
    running, _ = serve()
    try:
        until(lambda: receiver.causes()[-1:] == ["34"], 60.0)
    finally:
        running.terminate()
        running.wait()
        database.close()
    receiver.verify(made["secret"])
    order = receiver.causes()
    assert list(dict.fromkeys(order)) == [str(count) for count in range(35)]
    assert len(order) <= 36, "only what was on its way may come twice"


def is_up(url: str) -> bool:
    try:
        return httpx2.get(f"{url}/healthz", trust_env=False).status_code == 200
    except httpx2.TransportError:
        return False

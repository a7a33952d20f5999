"""Brute force and quotas: refused with what may be done when, and only for whom it is meant (A8, A11, L4)."""

from __future__ import annotations

import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import httpx2

CSV = {"content-type": "text/csv"}


def rows(count: int, seed: int = 0) -> bytes:
    lines = [f"2026-01-01T00:{i // 60:02d}:{i % 60:02d}Z,{20000 + i + seed},-10000,30000,45000" for i in range(count)]
    return "\n".join(["time,bx,by,bz,ref_b", *lines, ""]).encode()


def satellite_of(client: httpx2.Client, name: str = "one") -> str:
    client.post("/satellites", json={"id": name}).raise_for_status()
    client.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    return f"/satellites/{name}/sessions?magnetometer=mgm"


def wrong_half(key: str) -> str:
    return key[:-1] + ("A" if key[-1] != "A" else "B")


def test_the_twenty_first_wrong_key_of_a_minute_is_429_and_right_keys_go_on(new_service):
    service = new_service()
    good = service.key("read")
    with service.client(wrong_half(good)) as guessing:
        answers = [guessing.get("/satellites") for _ in range(22)]
    assert [one.status_code for one in answers] == [401] * 20 + [429] * 2
    assert int(answers[-1].headers["retry-after"]) > 0
    assert answers[-1].json()["code"] == "too_many_failures"
    with service.client(good) as known, service.client("") as anonymous:
        assert known.get("/satellites").status_code == 200
        assert anonymous.get("/satellites").status_code == 401


def test_guesses_at_one_key_are_counted_whatever_the_address(new_service):
    """A proxy's word about the address does not buy further guesses at the same key."""
    service = new_service(auth_failures_per_minute=5)
    with service.client(wrong_half(service.key("read"))) as guessing:
        found = [guessing.get("/jobs", headers={"x-forwarded-for": f"10.0.0.{i}"}).status_code for i in range(8)]
    assert found == [401] * 5 + [429] * 3


def test_the_login_page_counts_guesses_too(new_service):
    service = new_service(auth_failures_per_minute=3)
    with service.client("") as browser:
        headers = {"origin": service.url, "sec-fetch-site": "same-origin"}
        form = {"key": wrong_half(service.admin_key)}
        found = [browser.post(f"{service.url}/login", data=form, headers=headers).status_code for _ in range(5)]
    assert found[-1] == 429
    assert 303 not in found


def test_jobs_past_the_quota_of_a_key_are_429_with_limit_and_reset(new_service):
    service = new_service(max_queued_jobs=2)
    with service.client() as admin:
        sent = admin.post(satellite_of(admin), content=rows(20), headers=CSV).json()
        body = {"kind": "calibration", "session_ids": [sent["id"]]}
        found = [admin.post("/jobs", json=body) for _ in range(3)]
        assert [one.status_code for one in found] == [202, 202, 429]
        assert found[2].json()["code"] == "quota"
        limits = {name: found[2].headers[f"ratelimit-{name}"] for name in ("limit", "remaining", "reset")}
        assert limits == {"limit": "2", "remaining": "0", "reset": found[2].headers["retry-after"]}
        with service.client(service.key("operate")) as other:
            assert other.post("/jobs", json=body).status_code == 202
        admin.post(f"/jobs/{found[0].json()['id']}/cancel").raise_for_status()
        assert admin.post("/jobs", json=body).status_code == 202


def test_bytes_past_the_quota_of_a_day_are_429_and_leave_nothing(new_service):
    service = new_service(max_mb_per_day=1)
    with service.client() as admin:
        path = satellite_of(admin)
        assert admin.post(path, content=rows(100), headers=CSV).status_code == 201
        refused = admin.post(path, content=rows(30_000), headers=CSV)
        assert (refused.status_code, refused.json()["code"]) == (429, "quota")
        assert 86_000 < int(refused.headers["retry-after"]) <= 86_401
        assert len(admin.get("/sessions").json()["items"]) == 1
        assert admin.post(path, content=rows(101), headers=CSV).status_code == 201


def test_one_key_cannot_take_every_place_for_uploads(new_service):
    """Two slow uploads fill the quota of their key: a third is 429 at once, another key's goes through."""
    service = new_service(max_uploads_per_key=2, max_uploads_at_once=3)
    release = threading.Event()

    def slow(content: bytes):
        yield content[:50]
        release.wait(20)
        yield content[50:]

    with service.client() as admin, service.client(service.key("ingest")) as other, ThreadPoolExecutor(3) as pool:
        path = satellite_of(admin)
        held = [pool.submit(post_slowly, service, path, slow(rows(10, seed))) for seed in range(2)]
        wait_for_uploads(service, 2)
        begun = time.monotonic()
        refused = admin.post(path, content=rows(10, 7), headers=CSV)
        assert time.monotonic() - begun < 5
        assert (refused.status_code, refused.json()["code"]) == (429, "quota")
        assert refused.headers["retry-after"] == "1"
        assert other.post(path, content=rows(10, 8), headers=CSV).status_code == 201
        third = pool.submit(post_slowly, service, path, slow(rows(10, 9)), service.key("ingest"))
        wait_for_uploads(service, 3)
        full = other.post(path, content=rows(10, 10), headers=CSV)
        assert (full.status_code, full.json()["code"], full.headers["retry-after"]) == (503, "busy", "1")
        release.set()
        assert [one.result() for one in [*held, third]] == [201, 201, 201]


def wait_for_uploads(service, count: int) -> None:
    deadline = time.monotonic() + 15
    while service.services.admission.in_flight < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def post_slowly(service, path, pieces, key=None) -> int:
    with service.client(key) as client:
        return client.post(path, content=pieces, headers=CSV).status_code


def test_a_crowd_is_accepted_or_told_to_come_back_and_never_cut_off(new_service):
    """Sixty stations over eight places: 201, 429 and 503, the last two with Retry-After; and all arrive at last."""
    service = new_service(max_uploads_at_once=8, max_uploads_per_key=6)
    keys = [service.key("ingest") for _ in range(4)]
    with service.client() as admin:
        path = satellite_of(admin)
    met: Counter[int] = Counter()

    def station(number: int) -> int:
        with service.client(keys[number % 4]) as client:
            for _ in range(200):
                answer = client.post(path, content=rows(10, number), headers=CSV)
                met[answer.status_code] += 1
                if answer.status_code not in {429, 503}:
                    return answer.status_code
                assert int(answer.headers["retry-after"]) >= 1
                time.sleep(0.05 + number % 7 / 50)
        return 0

    with ThreadPoolExecutor(40) as pool:
        ends = list(pool.map(station, range(60)))
    assert set(ends) == {201}
    assert set(met) <= {201, 429, 503}


def test_pages_of_a_list_are_bounded(api):
    assert api.get("/sessions", params={"limit": 1000}).status_code == 200
    for limit in ("1001", "0", "-1", "1e9", "ten"):
        assert api.get("/sessions", params={"limit": limit}).status_code == 422


def test_an_answer_does_not_wait_for_the_acknowledgement_of_its_headers(new_service):
    """With Nagle's algorithm every answer on one connection takes 40 ms; the fastest of thirty takes far less."""
    service = new_service()
    took = []
    with service.client("") as client:
        for _ in range(30):
            begun = time.perf_counter()
            client.get(f"{service.url}/healthz").raise_for_status()
            took.append(time.perf_counter() - begun)
    assert min(took) < 0.02

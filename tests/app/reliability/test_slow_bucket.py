"""A bucket that answers slowly, with errors, with half of a body, or loses what it acknowledged."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.maintenance.audit import audit
from app.settings import Settings

SPEC = importlib.util.spec_from_file_location("bucket_server", Path(__file__).with_name("bucket_server.py"))
assert SPEC is not None
assert SPEC.loader is not None
bucket_server = importlib.util.module_from_spec(SPEC)
sys.modules["bucket_server"] = bucket_server
SPEC.loader.exec_module(bucket_server)

CSV = {"content-type": "text/csv"}
LONGEST_ANSWER_S = 20.0
"""A client is told within so long that the bucket fails; three tries of the service take about a second of it."""


def content(number: int) -> bytes:
    rows = (f"2020-01-01T00:00:{s:02d}Z,{20000 + number},{s},2,20000\n" for s in range(40))
    return ("time,bx,by,bz,ref_b\n" + "".join(rows)).encode()


@pytest.fixture(scope="module")
def bucket() -> Iterator:
    with bucket_server.serving_bucket() as server:
        yield server


@pytest.fixture(scope="module")
def service(bucket, serving, tmp_path_factory) -> Iterator:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "AWS_ENDPOINT_URL": bucket.url, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "eu-central-1",
            "AWS_ACCESS_KEY_ID": "AKIAMAGCAL", "AWS_SECRET_ACCESS_KEY": "not-a-secret",
        }.items():  # fmt: skip
            patch.setenv(name, value)
        folder = tmp_path_factory.mktemp("bucket")
        yield from serving(Settings(data_dir=folder, workers=0, min_free_mb=0, store_url="s3://kept/under"))


@pytest.fixture(scope="module")
def api(service) -> Iterator:
    with service.client() as client:
        client.post("/satellites", json={"id": "a"}).raise_for_status()
        client.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        yield client


@pytest.fixture(autouse=True)
def sound(bucket) -> Iterator[None]:
    yield
    bucket.faults.clear()


def send(api, number: int):
    return api.post("/satellites/a/sessions?magnetometer=m", content=content(number), headers=CSV)


def read(api, session_id: str):
    return api.get(f"/sessions/{session_id}/samples", headers={"accept": "text/csv"})


def is_whole(api, session_id: str, number: int) -> bool:
    """Return whether every reading that was sent is given out."""
    rows = read(api, session_id).raise_for_status().text.splitlines()[1:]
    sent = content(number).decode().splitlines()[1:]
    return len(rows) == len(sent) and all(f"{20000 + number}" in row for row in rows)


@pytest.mark.parametrize("fault", bucket_server.FAULTS)
def test_what_the_bucket_does_not_keep_is_not_acknowledged_and_is_whole_when_it_is_sent_again(
    service, api, bucket, fault
):
    number = 10 + bucket_server.FAULTS.index(fault)
    bucket.faults["PUT"] = fault
    begun_s = time.monotonic()
    refused = send(api, number)
    assert (refused.status_code, refused.json()["code"]) == (503, "unavailable")
    assert "retry-after" in refused.headers
    assert time.monotonic() - begun_s < LONGEST_ANSWER_S
    bucket.faults.clear()
    kept = send(api, number)
    assert kept.status_code == 201, kept.text
    assert is_whole(api, kept.json()["id"], number)
    assert audit(service.database, service.services.store).findings == ()


def test_a_slow_bucket_is_waited_for(api, bucket):
    bucket.faults |= dict.fromkeys(("PUT", "GET", "HEAD"), "slow")
    kept = send(api, 30)
    assert kept.status_code == 201
    assert is_whole(api, kept.json()["id"], 30)


@pytest.mark.parametrize("fault", bucket_server.WRONG_READS)
def test_no_wrong_byte_of_the_bucket_is_given_out(api, bucket, fault):
    session_id = send(api, 40).json()["id"]
    bucket.faults["GET"] = fault
    begun_s = time.monotonic()
    answer = read(api, session_id)
    assert answer.status_code in {500, 503}
    assert answer.json()["code"] in {"unavailable", "stored_object_corrupt"}
    assert time.monotonic() - begun_s < LONGEST_ANSWER_S
    bucket.faults.clear()
    assert is_whole(api, session_id, 40)

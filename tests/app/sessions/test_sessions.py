"""Telemetry in and out over HTTP."""

import base64
import gzip
import hashlib
import io
import json
import socket
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pyarrow.parquet as pq
import pytest
import zstandard

CSV = {"content-type": "text/csv"}


def rows(count: int, first: int = 0) -> bytes:
    """Return telemetry of a plausible field, one sample every ten seconds."""
    lines = [
        f"2026-01-01T{(first + i) // 360:02d}:{(first + i) // 6 % 60:02d}:{(first + i) % 6 * 10:02d}Z,"
        f"{20000 + i},{-10000 - 2 * i},{30000 - 3 * i},45000"
        for i in range(count)
    ]
    return "\n".join(["time,bx,by,bz,ref_b", *lines, ""]).encode()


def upload(api: httpx2.Client, satellite: str, content: bytes, **headers: str) -> httpx2.Response:
    """Send telemetry of the magnetometer ``mgm``."""
    return api.post(
        f"/satellites/{satellite}/sessions",
        params={"magnetometer": "mgm"},
        content=content,
        headers=CSV | {name.replace("_", "-"): value for name, value in headers.items()},
    )


def test_an_upload_is_a_session_known_by_its_bytes(api, satellite):
    content = rows(20)
    made = upload(api, satellite, content)
    assert made.status_code == 201
    session = made.json()
    assert made.headers["location"] == f"/api/v1/sessions/{session['id']}"
    assert session["sha256"] == hashlib.sha256(content).hexdigest()
    assert (session["samples"], session["used_samples"], session["state"]) == (20, 20, "closed")
    assert (session["data_from"], session["data_until"]) == (
        "2026-01-01T00:00:00.000000Z",
        "2026-01-01T00:03:10.000000Z",
    )
    assert session["columns"] == ["time", "bx", "by", "bz", "ref_b"]


def test_the_same_bytes_again_are_the_same_session(api, satellite):
    first, second = upload(api, satellite, rows(10)), upload(api, satellite, rows(10))
    assert (first.status_code, second.status_code) == (201, 200)
    assert first.json() == second.json()


@pytest.mark.parametrize("size", [(1 << 20) - 1, 1 << 20, (1 << 20) + 1, (2 << 20) + 5])
def test_a_body_at_the_edge_of_what_is_held_in_memory_arrives_whole(api, satellite, size):
    table = rows(200)
    lines, rest = divmod(size - len(table), 1000)
    content = b"#" * (rest + 999) + b"\n" + (b"#" * 999 + b"\n") * (lines - 1) + table
    made = upload(api, satellite, content).json()
    assert (made["size_bytes"], made["samples"]) == (size, 200)
    assert made["sha256"] == hashlib.sha256(content).hexdigest()


def test_the_same_bytes_of_two_satellites_are_two_sessions(api, names, satellite):
    other = next(names)
    api.post("/satellites", json={"id": other})
    api.post(f"/satellites/{other}/magnetometers", json={"id": "mgm", "unit": "nT"})
    first, second = upload(api, satellite, rows(10)), upload(api, other, rows(10))
    assert (first.status_code, second.status_code) == (201, 201)
    assert first.json()["id"] != second.json()["id"]


def test_ten_stations_that_send_one_pass_at_once_make_one_session(service, api, satellite):
    content = rows(200)

    def send(_number: int) -> tuple[int, str]:
        with service.client() as station:
            answer = upload(station, satellite, content)
            return answer.status_code, answer.json()["id"]

    with ThreadPoolExecutor(10) as stations:
        answers = list(stations.map(send, range(10)))
    assert sorted(status for status, _ in answers) == [200] * 9 + [201]
    assert len({session_id for _, session_id in answers}) == 1


@pytest.mark.parametrize(("coding", "pack"), [("gzip", gzip.compress), ("zstd", zstandard.ZstdCompressor().compress)])
def test_a_content_coding_is_taken_off_before_the_bytes_are_kept(api, satellite, coding, pack):
    content = rows(30)
    made = upload(api, satellite, pack(content), content_encoding=coding)
    assert made.status_code == 201
    assert made.json()["sha256"] == hashlib.sha256(content).hexdigest()
    assert upload(api, satellite, content).status_code == 200


def test_a_digest_is_checked_and_a_wrong_one_leaves_nothing(api, satellite):
    content = rows(12)
    right = base64.b64encode(hashlib.sha256(content).digest()).decode()
    wrong = base64.b64encode(hashlib.sha256(b"other").digest()).decode()
    refused = upload(api, satellite, content, content_digest=f"sha-256=:{wrong}:")
    assert (refused.status_code, refused.json()["code"]) == (400, "digest_mismatch")
    assert api.get("/sessions", params={"satellite": satellite}).json()["items"] == []
    assert upload(api, satellite, content, content_digest=f"sha-256=:{right}:, unixsum=:AAA=:").status_code == 201
    assert upload(api, satellite, content, content_digest="sha-256=nonsense").json()["code"] == "digest_form"


def test_an_idempotency_key_with_another_body_is_refused(api, satellite):
    first = upload(api, satellite, rows(10), idempotency_key="pass-1")
    again = upload(api, satellite, rows(10), idempotency_key="pass-1")
    other = upload(api, satellite, rows(11), idempotency_key="pass-1")
    assert (first.status_code, again.status_code, again.json()["id"]) == (201, 200, first.json()["id"])
    assert (other.status_code, other.json()["code"]) == (422, "idempotency_mismatch")


def test_faults_of_a_table_are_told_by_row_and_column_without_the_value(api, satellite):
    refused = upload(api, satellite, rows(10) + b"2026-01-02T00:00:00Z,oops,2,3,4\n")
    assert refused.status_code == 422
    assert "oops" not in refused.text
    assert refused.json()["errors"][0]["where"] == "line 12, column bx"


def test_times_without_a_zone_are_refused(api, satellite):
    refused = upload(api, satellite, rows(10).replace(b"Z,", b","))
    assert (refused.status_code, refused.json()["code"]) == (422, "time_zone_missing")


def test_a_body_of_another_type_is_refused(api, satellite):
    refused = api.post(
        f"/satellites/{satellite}/sessions",
        params={"magnetometer": "mgm"},
        content=b"<html>",
        headers={"content-type": "text/html"},
    )
    assert refused.status_code == 415


def test_a_body_past_the_limit_is_refused_before_it_is_read(service, satellite):
    request = (
        f"POST /api/v1/satellites/{satellite}/sessions?magnetometer=mgm HTTP/1.1\r\nHost: localhost\r\n"
        f"Authorization: Bearer {service.admin_key}\r\nContent-Length: 46000000000\r\n\r\n"
    )
    address = ("127.0.0.1", int(service.url.rpartition(":")[2]))
    with socket.create_connection(address, timeout=10) as connection:
        connection.sendall(request.encode())
        answer = b""
        while b"upload_too_large" not in answer and (piece := connection.recv(65536)):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 413")


def test_a_body_without_a_length_is_cut_at_the_limit(service, api, satellite):
    pieces = (b"x" * 100_000 for _ in range(80))
    refused = api.post(f"/satellites/{satellite}/sessions", params={"magnetometer": "mgm"}, content=pieces, headers=CSV)
    assert (refused.status_code, refused.json()["code"]) == (413, "upload_too_large")
    assert list((service.settings.data_dir / "incoming").iterdir()) == []


def test_a_decompression_bomb_is_refused(api, satellite):
    refused = upload(api, satellite, gzip.compress(bytes(200 << 20)), content_encoding="gzip")
    assert (refused.status_code, refused.json()["code"]) == (422, "decompression_limit")


def test_samples_come_back_in_every_format(api, satellite):
    session_id = upload(api, satellite, rows(5)).json()["id"]
    path = f"/sessions/{session_id}/samples"
    as_json = api.get(path, headers={"accept": "application/json"})
    assert as_json.json()["bx"] == [20000, 20001, 20002, 20003, 20004]
    as_csv = api.get(path, headers={"accept": "text/csv"})
    assert as_csv.text.splitlines()[0] == "time,bx,by,bz,ref_b"
    assert as_csv.text.splitlines()[1].startswith("2026-01-01T00:00:00.000000Z,20000")
    lines = api.get(path, headers={"accept": "application/x-ndjson"}).text.splitlines()
    assert json.loads(lines[4])["bz"] == 29988
    table = pq.read_table(io.BytesIO(api.get(path, headers={"accept": "application/vnd.apache.parquet"}).content))
    assert table.column("by").to_pylist() == [-10000, -10002, -10004, -10006, -10008]
    assert api.get(path, headers={"accept": "image/png"}).status_code == 406


def test_samples_can_be_cut_in_time_and_bear_their_flags(api, satellite):
    session_id = upload(api, satellite, rows(10)).json()["id"]
    query = {"since": "2026-01-01T00:00:20Z", "until": "2026-01-01T00:00:40Z", "flags": "true", "format": "json"}
    cut = api.get(f"/sessions/{session_id}/samples", params=query).json()
    assert cut["bx"] == [20002, 20003, 20004]
    assert cut["magcal_flags"] == [0, 0, 0]


@pytest.mark.parametrize("year", ["0001", "2600", "9999"])
def test_a_bound_beyond_the_years_of_the_core_keeps_what_it_says(api, satellite, year):
    """Nanoseconds reach from 1677 to 2262; a bound beyond is before or after every sample, as its year says."""
    session_id = upload(api, satellite, rows(10)).json()["id"]
    far = f"{year}-06-01T00:00:00Z"
    counts = [
        len(api.get(f"/sessions/{session_id}/samples", params={bound: far, "format": "json"}).json().get("bx", []))
        for bound in ("since", "until")
    ]
    assert counts == ([10, 0] if year == "0001" else [0, 10])


def test_an_open_session_takes_chunks_in_any_order_and_once_each(api, satellite):
    opened = api.post(f"/satellites/{satellite}/sessions", params={"magnetometer": "mgm", "open": "true"})
    assert (opened.status_code, opened.json()["state"]) == (201, "open")
    path = f"/sessions/{opened.json()['id']}"
    for chunk in (rows(5, 5), rows(5, 0), rows(5, 5)):
        assert api.post(f"{path}/samples", content=chunk, headers=CSV).status_code == 200
    closed = api.post(f"{path}/close").json()
    assert (closed["state"], closed["samples"]) == ("closed", 10)
    assert closed["data_from"] == "2026-01-01T00:00:00.000000Z"
    times = api.get(f"{path}/samples").json()["time"]
    assert times == sorted(times)
    assert [chunk["samples"] for chunk in api.get(path).json()["chunks"]] == [5, 5]
    refused = api.post(f"{path}/samples", content=rows(5, 50), headers=CSV)
    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
    assert api.post(f"{path}/close").json() == closed


def test_axes_and_unit_are_those_of_the_magnetometer(api, satellite):
    sensor = {"id": "turned", "unit": "uT", "axis_map": ["y", "-x", "z"], "columns": {"bx": "m0"}}
    api.post(f"/satellites/{satellite}/magnetometers", json=sensor).raise_for_status()
    content = b"time,m0,by,bz\n2026-01-01T00:00:00Z,1,20,30\n2026-01-01T00:00:10Z,2,21,31\n"
    session = api.post(
        f"/satellites/{satellite}/sessions", params={"magnetometer": "turned"}, content=content, headers=CSV
    ).json()
    samples = api.get(f"/sessions/{session['id']}/samples").json()
    assert (samples["bx"], samples["by"], samples["bz"]) == ([20000, 21000], [-1000, -2000], [30000, 31000])


def test_sessions_of_another_satellite_are_not_there(service, api, satellite):
    session_id = upload(api, satellite, rows(10)).json()["id"]
    with service.client(service.key("admin", satellites=["mine"])) as bound:
        nothing = bound.get("/sessions/" + "0" * 32)
        for path in ("", "/samples"):
            assert bound.get(f"/sessions/{session_id}{path}").content == nothing.content
        assert bound.post(f"/sessions/{session_id}/samples", content=rows(3), headers=CSV).content == nothing.content
        assert bound.get("/sessions").json()["items"] == []
        assert upload(bound, satellite, rows(10)).status_code == 404


def test_stored_bytes_that_have_changed_are_told(service, api, satellite):
    session = upload(api, satellite, rows(40)).json()
    with service.database.write() as database:
        connection = database.connection()
        key = f"columns/{session['id']}/0"
        content = connection.exec_driver_sql("SELECT content FROM blob_part WHERE key = ?", (key,)).scalar_one()
        broken = content[:-20] + bytes([content[-20] ^ 1]) + content[-19:]
        connection.exec_driver_sql("UPDATE blob_part SET content = ? WHERE key = ?", (broken, key))
    refused = api.get(f"/sessions/{session['id']}/samples")
    assert (refused.status_code, refused.json()["code"]) == (500, "stored_object_corrupt")

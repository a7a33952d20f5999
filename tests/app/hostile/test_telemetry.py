"""Telemetry as nobody should send it (B5 to B11, B13, B16 to B20, B22)."""

from __future__ import annotations

import gzip
import io
import time
import zipfile
from pathlib import Path

import pytest
import zstandard

HEADER = "time,bx,by,bz,ref_b\n"


def line(i: int, reading: str = "20000,-10000,30000", when: str | None = None) -> str:
    return f"{when or f'2026-01-01T{i // 60:02d}:{i % 60:02d}:00Z'},{reading},37416\n"


def table(count: int = 40, **changed: str) -> str:
    """Return a table whose rows ``r3``, ``r7``, ... have other readings."""
    return HEADER + "".join(line(i, changed.get(f"r{i}", f"{20000 + i},-10000,30000")) for i in range(count))


@pytest.mark.parametrize("cell", ["NaN", "nan", "Inf", "-inf", "", "-9999", "1e308", "-1e300"])
def test_a_cell_that_is_no_reading_flags_its_sample_and_never_reaches_a_fit(send, api, cell):
    session = send(table(r5=f"{cell},-10000,30000")).raise_for_status().json()
    assert (session["samples"], session["used_samples"]) == (40, 39)
    answer = api.get(f"/sessions/{session['id']}/samples", params={"flags": "true"})
    assert answer.status_code == 200
    flags = answer.json()["magcal_flags"]
    assert [i for i, flag in enumerate(flags) if flag] == [5]


def test_denormals_are_numbers(send):
    assert send(table(r5="5e-324,-10000,30000")).json()["used_samples"] == 40


@pytest.mark.parametrize("cell", ["NaN", "Infinity", "1e999", "-Infinity"])
def test_json_that_holds_no_number_is_refused_or_flagged_and_never_a_500(send, cell):
    columns = {"time": [f"2026-01-01T00:{i:02d}:00Z" for i in range(30)], "by": [1e4] * 30, "bz": [3e4] * 30}
    text = str({**columns, "bx": ["CELL", *[2e4] * 29]}).replace("'CELL'", cell).replace("'", '"')
    answer = send(text, content_type="application/json")
    assert answer.status_code in {201, 422}, answer.text
    if answer.status_code == 201:
        assert answer.json()["used_samples"] == 29


def test_more_than_half_without_a_reading_is_refused(send, check):
    bad = {f"r{i}": "NaN,NaN,NaN" for i in range(21)}
    check(send(table(**bad)), 422, "too_many_bad_samples")


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "uT"), (1e-6, "mT"), (1e-5, "G"), (1e-9, "T"), (1e-2, "mG")])
def test_readings_in_another_unit_than_the_magnetometer_s_are_refused_by_name(send, check, factor, unit):
    rows = "".join(
        f"2026-01-01T00:{i:02d}:00Z,{(20000 + i) * factor:.9g},{-10000 * factor:.9g},{30000 * factor:.9g}\n"
        for i in range(40)
    )
    body = check(send("time,bx,by,bz\n" + rows), 422, "units_mismatch")
    assert unit in body["detail"]


def test_a_magnetometer_without_a_known_unit_cannot_be_made(api, satellite, check):
    for body in ({"id": "m"}, {"id": "m", "unit": "gamma"}, {"id": "m", "unit": None}, {"id": "m", "unit": "nt"}):
        check(api.post(f"/satellites/{satellite}/magnetometers", json=body), 422, "invalid")


def test_rows_out_of_order_give_the_samples_of_rows_in_order(send, api):
    header, *rows = table().splitlines(keepends=True)
    shuffled = header + "".join(rows[::-1][7:] + rows[::-1][:7])
    first, second = send(table()).json(), send(shuffled).json()
    assert second["quality"]["unsorted"] > 0 if "unsorted" in second["quality"] else second["samples"] == 40
    found = [
        api.get(f"/sessions/{one['id']}/samples", headers={"accept": "text/csv"}).content for one in (first, second)
    ]
    assert found[0] == found[1]


def test_a_row_sent_twice_counts_once_and_two_truths_of_one_time_count_not_at_all(send, check):
    twice = HEADER + "".join(line(i, f"{20000 + i},-10000,30000") for i in (*range(200), 7))
    assert send(twice).json()["used_samples"] == 200
    two_truths = HEADER + "".join(line(i, f"{20000 + i},-10000,30000") for i in range(200)) + line(7)
    session = send(two_truths).json()
    assert session["used_samples"] == 199
    many = table(40) + "".join(line(i) for i in range(1, 20))
    check(send(many), 422, "time_conflict")


@pytest.mark.parametrize(
    ("when", "code"),
    [
        ("2026-01-01T00:00:00", "time_zone_missing"),
        ("2026-03-29 02:30:00", "time_zone_missing"),
        ("1767225600000", "time"),
        ("1767225600000000", "time"),
        ("1767225600000000000", "time"),
        ("1970-01-01T00:00:00Z", "time"),
        ("2106-02-07T06:28:16Z", "time"),
        ("9999-12-31T23:59:59Z", "time"),
        ("2026-01-01T00:00:60Z", "time"),
        ("2026-02-30T00:00:00Z", "time"),
        ("01/02/2026 00:00", "time"),
    ],
)
def test_times_that_could_be_meant_otherwise_are_refused(send, check, when, code):
    check(send(HEADER + line(0, when=when)), 422, code)


def test_offsets_are_converted_and_a_leap_second_is_a_time(send):
    text = HEADER + line(0, when="2016-12-31T23:59:60Z") + line(0, when="2017-01-01T02:00:01+02:00")
    session = send(text).json()
    assert session["data_until"] == "2017-01-01T00:00:01.000000Z"
    assert session["data_from"] == "2017-01-01T00:00:00.000000Z"


def test_attitudes_that_are_no_rotation_are_flagged(send):
    rows = [line(i).replace("\n", f",{q}\n") for i, q in enumerate(["1,0,0,0"] * 40)]
    rows[3], rows[4], rows[5] = (
        line(i).replace("\n", f",{q}\n") for i, q in ((3, "0,0,0,0"), (4, "NaN,0,0,0"), (5, "0.5,0,0,0"))
    )
    session = send(HEADER.replace("\n", ",qw,qx,qy,qz\n") + "".join(rows)).json()
    assert session["samples"] == 40
    assert sum(value for value in session["quality"]["flags"].values() if isinstance(value, int)) == 3


def test_more_rows_than_allowed_and_lines_past_four_kib_are_refused_at_once(new_service, check):
    service = new_service(max_rows=1000)
    with service.client() as admin:
        admin.post("/satellites", json={"id": "one"}).raise_for_status()
        admin.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()

        def post(content):
            return admin.post(
                "/satellites/one/sessions?magnetometer=mgm", content=content, headers={"content-type": "text/csv"}
            )

        check(post(table(1200)), 422, "too_many_rows")
        begun = time.monotonic()
        check(post(HEADER + "x" * 50_000_000), 422, "telemetry_format")
        check(post(",".join(f"c{i}" for i in range(20_000)) + "\n"), 422, "telemetry_format")
        assert time.monotonic() - begun < 20


def zipped(*names: str) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name in names:
            archive.writestr(name, table())
    return out.getvalue()


GOOD = table().encode()
ZEROS = bytes(64 << 20)


@pytest.mark.parametrize(
    ("content", "coding", "code"),
    [
        (gzip.compress(ZEROS), "gzip", "decompression_limit"),
        (zstandard.ZstdCompressor().compress(ZEROS), "zstd", "decompression_limit"),
        (gzip.compress(gzip.compress(GOOD)), "gzip", "telemetry_format"),
        (gzip.compress(zipped("a.csv")), "gzip", "telemetry_format"),
        (gzip.compress(GOOD)[:-9], "gzip", "telemetry_format"),
        (zstandard.ZstdCompressor().compress(GOOD)[:-9], "zstd", "telemetry_format"),
        (gzip.compress(GOOD) + b"trailing", "gzip", "telemetry_format"),
        (gzip.compress(GOOD)[:20] + bytes(8) + gzip.compress(GOOD)[28:], "gzip", "telemetry_format"),
        (zipped("../../etc/passwd", "a.csv"), "identity", "telemetry_format"),
        (gzip.compress(ZEROS), "identity", "decompression_limit"),
    ],
    ids=[
        "gzip bomb",
        "zstd bomb",
        "nested",
        "zip in gzip",
        "cut",
        "zstd cut",
        "trailing",
        "corrupt",
        "zip",
        "undeclared",
    ],
)
def test_bodies_that_are_compressed_wrongly_or_wickedly_are_refused(send, check, content, coding, code):
    check(send(content, content_encoding=coding), 422, code)


def test_two_members_of_one_gzip_stream_are_one_body(send):
    half = len(GOOD) // 2
    assert send(gzip.compress(GOOD[:half]) + gzip.compress(GOOD[half:]), content_encoding="gzip").status_code == 201


def test_a_coding_that_the_body_does_not_have_is_refused(send, check):
    check(send(GOOD, content_encoding="gzip"), 415, "unsupported_media_type")
    check(send(GOOD, content_encoding="br"), 415, "unsupported_media_type")
    check(send(gzip.compress(GOOD), content_encoding="gzip, gzip"), 415, "unsupported_media_type")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1"])
def test_other_encodings_than_utf8_are_refused(send, check, encoding):
    check(send(table().replace("time", "t\u00efme").encode(encoding)), 422, "encoding")


def test_nul_bytes_are_refused_and_a_byte_order_mark_is_not(send, check):
    check(send(table().replace("20003", "2\x00003")), 422, "encoding")
    assert send("\ufeff" + table()).status_code == 201


@pytest.mark.parametrize(
    ("content_type", "content"),
    [
        ("application/vnd.apache.parquet", GOOD),
        ("application/json", GOOD),
        ("application/x-ndjson", GOOD),
        ("text/csv", b"PAR1" + bytes(100) + b"PAR1"),
        ("application/vnd.apache.parquet", b"PAR1" + bytes(100) + b"PAR1"),
        ("text/csv", b""),
        ("text/csv", b"\n\n\n"),
        ("application/json", b"[" * 100_000),
        ("application/json", b'{"time": ' + b"[" * 500 + b"]" * 500 + b"}"),
        ("application/json", b'{"time": [1' + b"0" * 5000 + b"]}"),
        ("application/x-ndjson", b'{"time": "\\ud800", "bx": 1, "by": 2, "bz": 3}'),
    ],
)
def test_content_of_another_type_than_declared_is_refused_and_quickly(send, content_type, content):
    begun = time.monotonic()
    answer = send(content, content_type=content_type)
    assert answer.status_code in {400, 422}, answer.text
    assert time.monotonic() - begun < 5


@pytest.mark.parametrize("name", ["=cmd()", "+1", "-x", "@sum", "'quoted'", "a\tb"])
def test_column_names_that_a_spreadsheet_would_run_are_kept_and_defused_in_csv(send, api, name):
    header = f'{HEADER.strip()},"{name}"\n'
    answer = send(header + "".join(line(i).replace("\n", ",-3.2\n") for i in range(30)))
    if answer.status_code == 422:
        assert "\t" in name
        return
    session = answer.json()
    assert name in session["columns"]
    text = api.get(f"/sessions/{session['id']}/samples", headers={"accept": "text/csv"}).text
    first = text.splitlines()[0].split(",")[-1].strip('"')
    assert not first.startswith(("=", "+", "-", "@", "\t"))
    assert text.splitlines()[1].endswith(",-3.2")


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "%2e%2e%2fx", "CON", "a\x00b", ".", ".."])
def test_names_never_become_paths(service, api, name, satellite):
    before = {path for path in service.settings.data_dir.rglob("*") if path.is_file()}
    outside = set(service.settings.data_dir.parent.iterdir())
    # A NUL is refused at the door, where no schema has been asked yet.
    assert api.post("/satellites", json={"id": name}).status_code == (400 if "\0" in name else 422)
    headers = {"content-type": "text/csv", "content-disposition": f'attachment; filename="{name!a}"'}
    answer = api.post(f"/satellites/{satellite}/sessions?magnetometer=mgm", content=table(33), headers=headers)
    assert answer.status_code == 201
    new = {path for path in service.settings.data_dir.rglob("*") if path.is_file()} - before
    assert {path.name for path in new} <= {"magcal.db-wal", "magcal.db-shm"}
    assert set(service.settings.data_dir.parent.iterdir()) == outside
    assert Path("/etc/passwd").exists()


def test_every_hostile_file_is_refused_with_its_faults_and_every_good_one_accepted(api, names, data_dir):
    """The files of `tests/data/hostile`: the core's corpus goes through HTTP as well."""
    kinds = {".csv": "text/csv", ".json": "application/json", ".ndjson": "application/x-ndjson"}
    name = next(names)
    api.post("/satellites", json={"id": name}).raise_for_status()
    for path in sorted((data_dir / "hostile").iterdir()):
        kind = path.suffix.lstrip(".")
        api.post(f"/satellites/{name}/magnetometers", json={"id": kind, "unit": "nT"})
        answer = api.post(
            f"/satellites/{name}/sessions?magnetometer={kind}",
            content=path.read_bytes(),
            headers={"content-type": kinds.get(path.suffix, "application/vnd.apache.parquet")},
        )
        # Lines that were cut short have lost their last row alone: that is counted, and the rest is read.
        is_read = path.name.startswith("good") or path.name in {"truncated.csv", "truncated.ndjson"}
        wanted = 201 if is_read else 422
        assert answer.status_code == wanted, (path.name, answer.text)

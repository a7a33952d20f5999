"""Tables as stations write them: each form is read as the plain one is, or refused with what the user can do."""

import bz2
import io
import json
import lzma
import re
import zipfile

import numpy as np
import pytest

from magcal_core.errors import InputError, TelemetryFormatError, TelemetryValueError, UnitsError, UnitsMissingError
from magcal_core.telemetry import Telemetry, read_telemetry

RNG = np.random.default_rng(20261130)
N = 40
TIMES = [f"2024-05-11T03:{i // 6:02d}:{i % 6}0Z" for i in range(N)]
H_NT = np.round(RNG.normal(0.0, 1.0, (N, 3)) @ np.diag([2e4, 2e4, 2e4]) + [9e3, -7e3, 3e4], 2)
ROWS = [f"{t},{x},{y},{z}" for t, (x, y, z) in zip(TIMES, H_NT, strict=True)]
OBJECTS = [{"time": t, "bx": x, "by": y, "bz": z} for t, (x, y, z) in zip(TIMES, H_NT.tolist(), strict=True)]
PLAIN = "\n".join(["time,bx,by,bz", *ROWS]) + "\n"
BY_NAME = {"bx": "mag.x", "by": "mag.y", "bz": "mag.z"}


def read(body: str | bytes, **asked: object) -> Telemetry:
    content = body.encode() if isinstance(body, str) else body
    return read_telemetry(content, **{"max_bad_fraction": 0.2, **asked})  # type: ignore[arg-type]


def message(body: str | bytes, **asked: object) -> str:
    with pytest.raises(InputError) as caught:
        read(body, **asked)
    return caught.value.message


def assert_plain(telemetry: Telemetry) -> None:
    want = read(PLAIN).samples
    np.testing.assert_array_equal(telemetry.samples.t_utc, want.t_utc)
    np.testing.assert_array_equal(telemetry.samples.h_nt, want.h_nt)


def with_commas(text: str, separator: str) -> str:
    """Return the plain table with ``separator`` between its cells and decimal commas in its numbers."""
    return text.replace(",", separator).replace(".", ",")


@pytest.mark.parametrize(
    "text",
    [
        "# BRO-4, pass 12\n# time, bx, by, bz\n" + "\n".join(ROWS),
        "#time,bx,by,bz\n\n" + "\n".join(ROWS),
        "sep=,\n" + PLAIN,
        "sep=;\n" + PLAIN.replace(",", ";"),
        "BRO-4 magnetometer\nPass 12, day 132\n\n" + PLAIN,
        "Export of TLM\n=============\n" + PLAIN.replace(",", "\t"),
        PLAIN.replace("bz\n", "bz\nUTC,nT,nT,nT\n", 1),
        with_commas(PLAIN, ";"),
        with_commas(PLAIN, "\t"),
        "sep=;\n" + with_commas(PLAIN, ";"),
        "time;bx;by;bz\n" + with_commas("\n".join(ROWS), ";"),
    ],
    ids=["behind #", "behind #, close", "sep=,", "sep=;", "titles", "titles, tabs", "units", "decimal ;", "decimal tab",
         "sep=; decimal", "decimal rows"],
)  # fmt: skip
def test_a_csv_table_is_read_wherever_its_header_is_and_whatever_its_numbers_look_like(text: str) -> None:
    telemetry = read(text)
    assert_plain(telemetry)
    assert telemetry.quality.rows_unreadable == 0


def test_decimal_commas_are_read_cell_by_cell_too() -> None:
    """A leap second sends the table through the pass that reads line by line."""
    text = with_commas(PLAIN, ";") + "2016-12-31T23:59:60Z;30000,5;1,5;2\n"
    assert read(text).samples.h_nt[0].tolist() == [30000.5, 1.5, 2.0]


@pytest.mark.parametrize("title", ["", "My export\n"])
def test_a_table_without_any_header_is_refused_in_these_words(title: str) -> None:
    text = message(title + "\n".join(ROWS))
    assert f"the CSV table has no header at all: line {1 + bool(title)} is data already ('2024-05-11T03:00:00Z," in text
    assert "put the names of the columns in a line above it, such as time,bx,by,bz" in text


@pytest.mark.parametrize("is_fast", [True, False])
def test_a_header_among_the_rows_and_a_last_row_that_is_cut_are_bad_rows(is_fast: bool) -> None:
    lines = PLAIN.splitlines()
    lines[20:20] = ["time,bx,by,bz"]
    if not is_fast:
        lines.insert(1, "2016-12-31T23:59:60Z,30000,1,2")
    telemetry = read("\n".join(lines)[:-20])
    assert telemetry.quality.rows_unreadable == 2
    assert telemetry.quality.rows == N + 1 + (not is_fast)
    np.testing.assert_array_equal(telemetry.samples.h_nt[-(N - 1) :], H_NT[:-1])


def test_bad_rows_count_among_the_samples_that_are_missing() -> None:
    text = PLAIN.replace("\n2024-05-11T03:01", "\ntime,bx,by,bz\n2024-05-11T03:01")
    assert "6 of 46 samples (13.0 %)" in message(text, max_bad_fraction=0.1)


def test_a_row_that_ends_early_in_the_middle_stays_a_fault() -> None:
    lines = PLAIN.splitlines()
    lines[5] = lines[5][:25]
    assert "line 6: 2 cells, the header has 4" in message("\n".join(lines))


def test_a_last_ndjson_line_that_is_cut_is_a_bad_row() -> None:
    body = "\n".join(map(json.dumps, OBJECTS))[:-9]
    telemetry = read(body, format="ndjson")
    assert telemetry.quality.rows_unreadable == 1
    np.testing.assert_array_equal(telemetry.samples.h_nt, H_NT[:-1])


@pytest.mark.parametrize("gap", ["#N/A", "-", "--", "n/a", "NULL", ""])
def test_what_spreadsheets_write_for_a_missing_value_is_a_gap(gap: str) -> None:
    telemetry = read(PLAIN.replace(str(H_NT[7, 1]), gap))
    assert telemetry.quality.flags == {"not_finite": 1}
    assert not telemetry.samples.is_used[7]


HAPI = {
    "HAPI": "3.0",
    "status": {"code": 1200, "message": "OK"},
    "parameters": [
        {"name": "Timestamp", "type": "isotime", "units": "UTC", "length": 24, "fill": None},
        {"name": "B_VFM", "type": "double", "units": "nT", "size": [3], "fill": "-1e31"},
        {"name": "T_sensor", "type": "double", "units": "degC", "fill": "-999"},
    ],
}


@pytest.mark.parametrize("indent", [None, 2])
def test_the_csv_of_a_hapi_server_is_read_by_its_header_and_its_fill_values(indent: int | None) -> None:
    header = "".join(f"#{line}\n" for line in json.dumps(HAPI, indent=indent).splitlines())
    rows = [f"{row},{20 + i}" for i, row in enumerate(ROWS)]
    rows[3] = f"{TIMES[3]},-1e31,1,2,-999"
    body = header + "\n".join(rows)
    telemetry = read(body, columns={"bx": "B_VFM_0", "by": "B_VFM_1", "bz": "B_VFM_2"})
    assert telemetry.quality.flags == {"not_finite": 1, "no_housekeeping": 1}
    np.testing.assert_array_equal(telemetry.samples.h_nt[4:], H_NT[4:])
    assert telemetry.samples.housekeeping["T_sensor"][0] == 20.0
    assert 'the column map {"bx": "B_VFM_0", "by": "B_VFM_1", "bz": "B_VFM_2"}' in message(body)


@pytest.mark.parametrize("indent", [None, 1])
def test_a_hapi_header_of_hundreds_of_lines_or_of_one_long_one_is_read(indent: int | None) -> None:
    """400 parameters more than are looked at: 2,000 lines and more, or one of 40 kB; fill values as numbers, too."""
    more = [
        {"name": f"hk_{i}", "type": "double", "units": None, "fill": -999, "description": 'a "b"'} for i in range(400)
    ]
    document = HAPI | {"parameters": [*HAPI["parameters"], *more]}  # type: ignore[misc]
    header = "".join(f"#{line}\n" for line in json.dumps(document, indent=indent).splitlines())
    assert (header.count("\n") > 2000) if indent else (len(header) > 30_000)
    cells = ",".join(["-999", *(["1.5"] * 399)])
    body = header + "\n".join(f"{row},{20 + i},{cells}" for i, row in enumerate(ROWS))
    telemetry = read(body, columns={"bx": "B_VFM_0", "by": "B_VFM_1", "bz": "B_VFM_2"})
    np.testing.assert_array_equal(telemetry.samples.h_nt, H_NT)
    assert telemetry.samples.housekeeping["hk_399"][0] == 1.5
    assert telemetry.quality.flags.get("no_housekeeping", 0) == len(ROWS)


def test_a_comment_has_a_limit_of_its_own_and_rows_keep_theirs() -> None:
    assert_plain(read(f"#{'x' * 900_000}\n{PLAIN}"))
    assert "line 1 is longer than 1048576 bytes" in message(f"#{'x' * 1_100_000}\n{PLAIN}")
    assert "line 2 is longer than 4096 bytes" in message(PLAIN.replace("\n", f"\n{'1' * 5000}", 1))


def test_a_list_of_json_objects_is_a_table() -> None:
    assert_plain(read(json.dumps(OBJECTS)))
    assert "row 3: not a JSON object" in message(json.dumps([*OBJECTS[:2], 5]))
    assert "row 2, column bx: text, want a number or null: 'x\\x1b[31m'" in message(
        json.dumps([OBJECTS[0], OBJECTS[1] | {"bx": "x\x1b[31m"}])
    )


def nested(row: dict[str, object]) -> dict[str, object]:
    return {"header": {"time": row["time"]}, "mag": {"x": row["bx"], "y": row["by"], "z": row["bz"]}}


@pytest.mark.parametrize(
    "around",
    [{}, {"count": N, "next": None}, {"meta": {"station": "one", "page": 1}}],
    ids=["alone", "below counts", "below an object"],
)
@pytest.mark.parametrize("indent", [None, 2])
def test_the_rows_inside_an_answer_are_a_table(around: dict[str, object], indent: int | None) -> None:
    assert_plain(read(json.dumps({**around, "results": OBJECTS}, indent=indent)))
    assert_plain(read(json.dumps({"results": OBJECTS, **around}, indent=indent)))


def test_an_answer_with_two_lists_of_rows_is_refused() -> None:
    assert "column time: missing" in message(json.dumps({"results": OBJECTS, "others": OBJECTS}), format="json")


BLANKS = "\n".join(f"  {row.replace(',', '   ')} " for row in ROWS)


@pytest.mark.parametrize(
    "head",
    ["time bx by bz\n", "# time bx by bz\n", "My export\n\n#  made by hand\n   time    bx   by    bz  \n"],
    ids=["header", "comment", "below a title"],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_table_parted_by_blanks_is_read(head: str, end: str) -> None:
    assert_plain(read(f"{head}{BLANKS}\n".replace("\n", end)))


def test_what_numpy_writes_as_text_is_read() -> None:
    table = io.StringIO()
    epoch_s = np.array([t.rstrip("Z") for t in TIMES], "M8[s]").astype(np.int64)
    np.savetxt(table, np.c_[epoch_s, H_NT], header="time bx by bz")
    assert_plain(read(table.getvalue()))


def test_date_and_time_of_day_parted_by_blanks_are_two_columns() -> None:
    rows = BLANKS.replace("T", "  ").replace("Z", "")
    assert_plain(read(f"date time bx by bz\n{rows}\n", columns={"date": "date"}, time_format="utc"))


def archive_of(name: str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr(name, "<x/>")
    return content.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (archive_of("xl/workbook.xml"), "an Excel workbook"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(64), "an old Excel or Office file"),
        (archive_of("notes.txt"), "a zip archive"),
        (bz2.compress(PLAIN.encode()), "a bzip2 file"),
        (lzma.compress(PLAIN.encode()), "an xz file"),
        (b"%PDF-1.7\n1 0 obj\n", "a PDF document"),
        (b"\x89HDF\r\n\x1a\n" + bytes(64), "an HDF5 file"),
        (b"CDF\x01" + bytes(64), "a NetCDF file"),
        (b"\xcd\xf3\x00\x01\x00\x00\xff\xff" + bytes(64), "a CDF file"),
        (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "a MATLAB file"),
        (b"SQLite format 3\x00" + bytes(64), "an SQLite database"),
        (b"\n <!DOCTYPE html>\n<html><head><title>503 Busy\x1b[31m</title>", "an HTML page, '503 Busy"),
        (b'<?xml version="1.0"?><html><body>Log in', "an HTML page"),
    ],
)
@pytest.mark.parametrize("form", [None, "csv", "ndjson", "json", "parquet"])
def test_a_file_of_another_kind_is_named(content: bytes, words: str, form: str | None) -> None:
    said = message(content, format=form)
    assert words in said
    assert said.isprintable()


@pytest.mark.parametrize("name", ["BZh", "PK", "CDF", "Rar", "DAF"])
def test_a_column_may_have_the_name_that_another_kind_of_file_begins_with(name: str) -> None:
    rows = "\n".join(f"1.0,{row}" for row in ROWS)
    assert_plain(read(f"{name},time,bx,by,bz\n{rows}\n"))


@pytest.mark.parametrize("is_list", [True, False])
def test_nested_members_are_columns(is_list: bool) -> None:
    def body(rows: list[dict[str, object]]) -> str:
        return json.dumps(rows) if is_list else "\n".join(map(json.dumps, rows))

    assert_plain(read(body([nested(row) for row in OBJECTS]), columns=BY_NAME))
    own = [{"tm": {"time": row["time"]}, "mgm": {k: row[k] for k in ("bx", "by", "bz")}} for row in OBJECTS]
    assert_plain(read(body(own)))
    arrays = [{"time": row["time"], "b": [row["bx"], row["by"], row["bz"]]} for row in OBJECTS]
    for names in ("b[0]", "b[1]", "b[2]"), ("b.0", "b.1", "b.2"):
        assert_plain(read(body(arrays), columns=dict(zip(("bx", "by", "bz"), names, strict=True))))
    two = [nested(row) | {"mag2": {"bx": 1.0, "by": 1.0, "bz": 1.0}, "m": {"bx": row["bx"]}} for row in OBJECTS]
    assert "column bx: missing" in message(body(two))


LONG = [
    (t, name, value)
    for t, row in zip(TIMES, H_NT.tolist(), strict=True)
    for name, value in zip(("bx", "by", "bz"), row, strict=True)
]


@pytest.mark.parametrize(
    ("head", "prefix", "columns"),
    [
        ("time,parameter,value", "", None),
        ("Timestamp,Parameter,Value", "", None),
        ("time,name,eng_value", "/BRO4/ADCS/MGM/", None),
        ("t,p,v", "MGM.", {"time": "t", "parameter": "p", "value": "v"}),
        ("time,parameter,value", "EXT_", {"bx": "EXT_bx", "by": "EXT_by", "bz": "EXT_bz"}),
    ],
)
def test_long_tables_are_spread_out(head: str, prefix: str, columns: dict[str, str] | None) -> None:
    slow = [f"{TIMES[i]},{prefix}temperature,{20 + i}" for i in (0, 10)]
    text = "\n".join([head, *(f"{t},{prefix}{name},{value}" for t, name, value in LONG), *slow])
    telemetry = read(text, columns=columns)
    assert_plain(telemetry)
    (temperature,) = telemetry.samples.housekeeping.values()
    assert temperature.tolist() == [20.0] * 10 + [30.0] * 30


def test_long_tables_come_in_json_and_with_other_times_too() -> None:
    rows = [{"time": t, "parameter": name, "value": value} for t, name, value in LONG]
    assert_plain(read(json.dumps(rows)))
    assert_plain(read("\n".join(map(json.dumps, rows)), format="ndjson"))
    ms = ["ts,name,val", *(f"{np.datetime64(t[:-1], 'ms').astype(int)},{name},{v}" for t, name, v in LONG)]
    assert_plain(read("\n".join(ms), time_format="unix-ms"))
    assert "--time-format unix-ms" in message("\n".join(ms))
    seconds = ["ts,name,val", *(f"{np.datetime64(t[:-1], 's').astype(int)},{name},{v}" for t, name, v in LONG)]
    assert_plain(read("\n".join(seconds)))


def test_a_long_table_without_the_readings_says_which_parameters_it_has() -> None:
    text = "\n".join(["time,parameter,value", *(f"{t},mag_{name[1]},{v}" for t, name, v in LONG)])
    assert 'the column map {"bx": "mag_x", "by": "mag_y", "bz": "mag_z"}' in message(text)


@pytest.mark.parametrize(
    ("header", "wanted"),
    [
        ("Time,BX,BY,BZ", ("Time", "BX", "BY", "BZ")),
        ("TIME,mag_x [nT],mag_y [nT],mag_z [nT]", ("TIME", "mag_x [nT]", "mag_y [nT]", "mag_z [nT]")),
        ("Timestamp,Magnetometer X,Magnetometer Y,Magnetometer Z",
         ("Timestamp", "Magnetometer X", "Magnetometer Y", "Magnetometer Z")),
        ("utc,magX,magY,magZ", ("utc", "magX", "magY", "magZ")),
        ("time_utc,extmag_0,extmag_1,extmag_2", ("time_utc", "extmag_0", "extmag_1", "extmag_2")),
        ("DateTime,B_x (uT),B_y (uT),B_z (uT)", ("DateTime", "B_x (uT)", "B_y (uT)", "B_z (uT)")),
        ("t,MGM1,MGM2,MGM3", ("t", "MGM1", "MGM2", "MGM3")),
        ("ts,b_body_x,b_body_y,b_body_z", ("ts", "b_body_x", "b_body_y", "b_body_z")),
    ],
)  # fmt: skip
def test_near_names_of_columns_are_proposed_as_a_map_that_then_reads_the_table(
    header: str, wanted: tuple[str, ...]
) -> None:
    columns = dict(zip(("time", "bx", "by", "bz"), wanted, strict=True))
    # A torquer and a gyro beside the magnetometer are no readings of it.
    extra = ",mtq_x,mtq_y,mtq_z,gyro_x,gyro_y,gyro_z"
    body = "\n".join([header + extra, *(f"{row},1,2,3,4,5,6" for row in ROWS)])
    text = message(body)
    assert f"did you mean '{wanted[0]}'?" in text
    assert f"with the column map {json.dumps(columns)} (--columns, or the columns of the magnetometer)" in text
    pasted = json.loads(re.search(r"column map (\{.*?\})", text)[1])  # type: ignore[index]
    assert_plain(read(body, columns=pasted))


def test_a_column_that_the_map_misspells_is_proposed() -> None:
    body = PLAIN.replace("time,bx,by,bz", "time,extmag_0,extmag_1,extmag_2")
    text = message(body, columns={"bx": "extmag0", "by": "extmag_1", "bz": "extmag_2"})
    assert "column bx (mapped to 'extmag0'): missing; did you mean 'extmag_0'?" in text


def test_where_nothing_is_near_the_columns_of_the_table_are_listed() -> None:
    text = message(PLAIN.replace("time,bx,by,bz", "time,volt,amp,watt"))
    assert "column bx: missing; the table has: amp, time, volt, watt" in text
    assert "--columns" in text


@pytest.mark.parametrize("value", ["\x1b[31mred", "12..5", "\u202eevil", "x" * 500])
def test_the_value_that_could_not_be_read_stands_in_the_message_cut_and_escaped(value: str) -> None:
    text = message(PLAIN.replace(str(H_NT[3, 0]), value))
    shown = repr(value if len(value) <= 40 else value[:40] + "...")
    assert f"line 5, column bx: not a number: {shown}" in text
    assert text.isprintable()
    assert len(text) < 300


def test_names_of_columns_do_not_reach_a_terminal_raw() -> None:
    text = message(PLAIN.replace("bx", "b\u202ex").replace(str(H_NT[3, 1]), "y"))
    assert text.isprintable()


def test_fill_values_of_a_magnetometer_are_missing_readings() -> None:
    text = PLAIN.replace(str(H_NT[7, 1]), "-7777.7").replace(str(H_NT[9, 0]), "0.125")
    telemetry = read(text, fill_values=[-7777.7, 0.125])
    assert telemetry.quality.flags == {"not_finite": 2}
    assert np.isnan(telemetry.samples.h_nt[[7, 9]]).all()


@pytest.mark.parametrize(
    ("good", "bad", "values"),
    [
        ("1", "0", ()),
        ("true", "FALSE", ()),
        ("VALID", "invalid", ()),
        ("0", "3", (0,)),
        ("OK", "stale", ("ok",)),
        ("1", "", ()),
    ],
)
def test_a_validity_column_leaves_readings_out(good: str, bad: str, values: tuple[str | float, ...]) -> None:
    cells = [bad if i in (2, 5) else good for i in range(N)]
    bodies = [
        "\n".join(["time,bx,by,bz,mag_ok", *(f"{row},{cell}" for row, cell in zip(ROWS, cells, strict=True))]),
        json.dumps([row | {"mag_ok": cell} for row, cell in zip(OBJECTS, cells, strict=True)]),
        json.dumps({k: [row[k] for row in OBJECTS] for k in OBJECTS[0]} | {"mag_ok": cells}),
        "\n".join(json.dumps(row | {"mag_ok": cell}) for row, cell in zip(OBJECTS, cells, strict=True)),
    ]
    for body in bodies:
        telemetry = read(body, validity_column="mag_ok", valid_values=values)
        assert telemetry.quality.flags == {"not_finite": 2}
        assert np.flatnonzero(~telemetry.samples.is_used).tolist() == [2, 5]


def test_a_validity_column_follows_its_rows_into_the_order_of_time() -> None:
    rows = [f"{row},{int(i != 4)}" for i, row in enumerate(ROWS)]
    telemetry = read("\n".join(["time,bx,by,bz,ok", *rows[::-1]]), validity_column="ok")
    assert np.flatnonzero(~telemetry.samples.is_used).tolist() == [4]


def test_a_validity_column_that_is_not_there_is_refused() -> None:
    assert "column ok: missing: it is to say which readings are valid" in message(PLAIN, validity_column="ok")
    assert "no validity column" in message(PLAIN, valid_values=[1])


def test_counts_are_read_with_the_size_of_one() -> None:
    counts = np.round(H_NT / 7.5)
    body = "\n".join(
        ["time,bx,by,bz", *(f"{t},{x:.0f},{y:.0f},{z:.0f}" for t, (x, y, z) in zip(TIMES, counts, strict=True))]
    )
    np.testing.assert_allclose(read(body, unit="counts", nt_per_count=7.5).samples.h_nt, counts * 7.5, rtol=1e-15)
    with pytest.raises(UnitsMissingError, match=r"nT in one are not said: --nt-per-count \(nt_per_count\)"):
        read(body, unit="counts")
    with pytest.raises(UnitsError, match="with 7500 nT per count, want 10-70 uT; about "):
        read(body, unit="counts", nt_per_count=7500.0)
    with pytest.raises(UnitsError, match="nT per count are given, and the unit is 'uT'"):
        read(body, unit="uT", nt_per_count=7.5)


def test_two_numbers_with_commas_in_a_comma_table_stay_a_fault() -> None:
    with pytest.raises(TelemetryFormatError, match="cells, the header has 4"):
        read("time,bx,by,bz\n" + "\n".join(f"{t},30000,5,1,5,2,5" for t in TIMES))


def test_thousands_among_decimal_commas_are_no_numbers() -> None:
    with pytest.raises(TelemetryValueError, match="not a number: '1,234,567'"):
        read("time;bx;by;bz\n" + "\n".join(f"{t};1,234,567;1,5;2,5" for t in TIMES))

"""Orbits as nobody should send them (B1, B2, B3, B4)."""

from __future__ import annotations

import json

import pytest

from magcal_core.simulation.dekart_mission import tle_text

NAME, LINE_1, LINE_2, *_ = tle_text().splitlines()
ROWS = [f"{20000 + i},{-10000 - 2 * i},{30000 - 3 * i}" for i in range(30)]


def summed(line: str) -> str:
    """Return the line with the checksum that its other digits have."""
    total = sum(int(c) if c.isdigit() else c == "-" for c in line[:68])
    return f"{line[:68]}{total % 10}"


@pytest.fixture
def kept(api, satellite):
    """Return what the satellite has of orbits."""
    return lambda: api.get(f"/satellites/{satellite}/orbits").json()["items"]


def telemetry(day: str) -> str:
    return "time,bx,by,bz\n" + "".join(f"{day}T00:{i:02d}:00Z,{row}\n" for i, row in enumerate(ROWS))


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (f"{LINE_1[:-1]}{(int(LINE_1[-1]) + 1) % 10}\n{LINE_2}", "tle_checksum"),
        (f"{LINE_1}\n{LINE_2[:10]}{(int(LINE_2[10]) + 4) % 10}{LINE_2[11:]}", "tle_checksum"),
        (f"{LINE_1[:-1]}\n{LINE_2}", "tle_format"),
        (f"{LINE_1} \n{LINE_2}0", "tle_format"),
        (f"{LINE_1[:40]}\n{LINE_2[:40]}", "tle_format"),
        (f"{LINE_2}\n{LINE_1}", "tle_format"),
        (f"{LINE_1}\n{summed(LINE_2.replace('46493', '46494', 1))}", "tle_format"),
        (LINE_1, "tle_format"),
        (f"{LINE_1}\n{LINE_2}".replace(" ", "\t"), "tle_format"),
        (f"{LINE_1}\n{LINE_2}".replace(" ", "\u00a0"), "tle_format"),
        (f"{LINE_1[:20]}\u00dc{LINE_1[21:]}\n{LINE_2}", "tle_format"),
        (f"{LINE_1}\n{summed(LINE_2.replace('97.7186', '197.718', 1))}", "tle_format"),
        (f"{LINE_1}\n{summed(LINE_2.replace('15.04187815', '00.00000000'))}", "tle_format"),
        (f"{LINE_1}\n{summed(LINE_2.replace('15.04187815', '99.99999999'))}", "tle_format"),
    ],
)
def test_a_tle_with_any_fault_is_refused_with_line_and_column(send_orbit, check, kept, text, code):
    body = check(send_orbit(text), 422, code)
    assert "line" in body["errors"][0]["where"]
    assert kept() == []


@pytest.mark.parametrize(
    "text",
    [
        f"{LINE_1}\n{LINE_2}",
        f"{NAME}\r\n{LINE_1}\r\n{LINE_2}\r\n",
        f"0 {NAME}\n{LINE_1}\n{LINE_2}\n",
        f"\n\n{LINE_1}\n{LINE_2}\n\n",
        f"{summed(LINE_1.replace('46493', 'A6493'))}\n{summed(LINE_2.replace('46493', 'A6493'))}",
    ],
)
def test_three_lines_crlf_blank_lines_and_alpha5_are_accepted(send_orbit, text):
    answer = send_orbit(text)
    assert answer.status_code == 201, answer.text
    assert len(answer.json()["items"]) == 1


def test_one_bad_tle_among_good_ones_leaves_none(send_orbit, check, api, satellite):
    check(send_orbit(f"{tle_text()}{LINE_1}\n{LINE_2[:-1]}x\n"), 422, "tle_format")
    assert api.get(f"/satellites/{satellite}/orbits").json()["items"] == []


def test_day_366_of_a_leap_year_is_the_right_epoch_and_years_from_57_on_are_of_the_last_century(send_orbit, check):
    """Where the Earth's rotation is not known there are no positions; the refusal says which year was understood."""
    answer = send_orbit(f"{summed(LINE_1.replace('22050.94287187', '20366.80000000'))}\n{LINE_2}")
    assert answer.status_code == 201, answer.text
    assert answer.json()["items"][0]["epoch"] == "2020-12-31T19:12:00.000000Z"
    for epoch, year in (("57001.00000000", "1957-01-01"), ("56001.00000000", "2056-01-01")):
        answer = send_orbit(f"{summed(LINE_1.replace('22050.94287187', epoch))}\n{LINE_2}")
        assert year in check(answer, 422, "model_range")["detail"]


def test_an_orbit_that_decays_at_once_is_refused_and_not_kept(send_orbit, api, satellite):
    """Mean motion of 17.9 revolutions a day is below the ground: SGP4 has no position for it."""
    answer = send_orbit(f"{LINE_1}\n{summed(LINE_2.replace('15.04187815', '17.90000000'))}")
    assert answer.status_code == 422
    assert answer.json()["code"] in {"tle_format", "propagation"}
    assert api.get(f"/satellites/{satellite}/orbits").json()["items"] == []


@pytest.mark.parametrize(
    ("content", "content_type", "codes"),
    [
        (b"", "text/plain", {"orbit_format", "tle_format"}),
        (b"\xff\xfe1\x00 \x00", "text/plain", {"encoding"}),
        (b"{", "application/json", {"orbit_format", "json"}),
        (b"{}", "application/json", {"orbit_format"}),
        (b"[]", "application/json", {"orbit_format"}),
        (b"[" * 20_000, "application/json", {"orbit_format", "json"}),
        (b"<ndm><omm", "application/xml", {"orbit_format"}),
        (b"CCSDS_OEM_VERS = 2.0\n", "text/plain", {"orbit_format"}),
        (b"\x00" * 1000, "text/plain", {"orbit_format", "tle_format", "encoding"}),
    ],
)
def test_what_is_no_orbit_message_is_refused(send_orbit, check, content, content_type, codes):
    answer = send_orbit(content, content_type)
    assert answer.json()["code"] in codes, answer.text
    check(answer, answer.status_code, answer.json()["code"])
    assert answer.status_code in {400, 422}


BOMB = """<?xml version="1.0"?><!DOCTYPE n [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><ndm><omm>&c;</omm></ndm>"""
OUTSIDE = '<?xml version="1.0"?><!DOCTYPE n [<!ENTITY x SYSTEM "file:///etc/passwd">]><ndm><omm>&x;</omm></ndm>'


@pytest.mark.parametrize("text", [BOMB, OUTSIDE])
def test_xml_that_defines_entities_is_refused_and_reads_no_file(send_orbit, check, text):
    answer = send_orbit(text, "application/xml")
    check(answer, 422, "orbit_format")
    assert "root:" not in answer.text


@pytest.mark.parametrize(
    "change",
    [
        {"position_km": [float("1e308"), 0.0, 0.0]},
        {"position_km": [0.0, 0.0, 0.0]},
        {"position_km": [7000.0, 0.0]},
        {"velocity_km_s": ["7.5", 0.0, 0.0]},
        {"velocity_km_s": [0.0, 300_000.0, 0.0]},
        {"epoch": "2026-01-01T00:00:00"},
        {"epoch": "9999-12-31T23:59:59Z"},
        {"epoch": 5},
        {"frame": "NED"},
        {"frame": None},
        {"position_km": None},
    ],
)
def test_a_state_vector_that_cannot_be_is_refused(send_orbit, change):
    state = {
        "epoch": "2026-01-01T00:00:00Z",
        "frame": "GCRF",
        "position_km": [6900.0, 0, 0],
        "velocity_km_s": [0, 7.6, 0],
    }
    answer = send_orbit(json.dumps(state | change), "application/json")
    assert answer.status_code == 422, answer.text
    assert answer.json()["code"] != "internal"


@pytest.mark.parametrize(("day", "status"), [("2022-02-20", 202), ("2022-03-03", 202), ("2022-03-15", 422)])
def test_an_orbit_serves_for_fourteen_days_and_then_only_where_the_job_says_so(api, send, send_orbit, day, status):
    send_orbit(f"{LINE_1}\n{LINE_2}").raise_for_status()
    session = send(telemetry(day)).raise_for_status().json()
    body = {"kind": "calibration", "session_ids": [session["id"]], "method": "scalar"}
    answer = api.post("/jobs", json=body)
    assert answer.status_code == status, answer.text
    if status == 422:
        assert answer.json()["code"] == "tle_epoch"
        assert api.post("/jobs", json=body | {"max_orbit_age_days": 60}).status_code == 202


ECHO = "Zq7Echo"


@pytest.mark.parametrize(
    ("text", "content_type"),
    [
        (f"{LINE_1[:18]}{ECHO}{LINE_1[25:]}\n{LINE_2}", "text/plain"),
        (
            f'{{"epoch": "{ECHO}", "frame": "GCRF", "position_km": [7000,0,0], "velocity_km_s": [0,7.5,0]}}',
            "application/json",
        ),
        (f'{{"epoch": "2026-01-01T00:00:00Z", "frame": "{ECHO}", "position_km": [7000,0,0]}}', "application/json"),
        (f'{{"OBJECT_NAME": "X", "EPOCH": "{ECHO}", "MEAN_MOTION": "{ECHO}"}}', "application/json"),
        (f"CCSDS_OEM_VERS = 2.0\nCREATION_DATE = {ECHO}\nMETA_START\nTIME_SYSTEM = {ECHO}\nMETA_STOP\n", "text/plain"),
        (f"<ndm><omm><EPOCH>{ECHO}</EPOCH></omm></ndm>", "application/xml"),
    ],
)
def test_no_refusal_repeats_what_the_message_said(send_orbit, text, content_type):
    answer = send_orbit(text, content_type)
    assert answer.status_code in {400, 422}, answer.text
    assert ECHO not in answer.text

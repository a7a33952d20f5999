"""TLE text: what is accepted, and what is named wrong with line and column."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sgp4.api import Satrec

from magcal_core.errors import TleChecksumError, TleFormatError
from magcal_core.orbit.messages.tle import checksum, parse_tles

LINE_1 = "1 46493U 20068H   22050.94287187  .00000000  00000-0  00000+0 0  9996"
LINE_2 = "2 46493  97.7186 352.5293 0017269 326.3404  33.6715 15.04187815    07"
PLAIN = f"{LINE_1}\n{LINE_2}\n"


def summed(line: str) -> str:
    return line[:68] + str(checksum(line))


def edited(line: str, first: int, text: str) -> str:
    """``line`` with ``text`` from column ``first`` on and the checksum made right."""
    return summed(line[: first - 1] + text + line[first - 1 + len(text) :])


def faults_of(text: str, kind: type[TleFormatError] = TleFormatError) -> list[str]:
    with pytest.raises(TleFormatError) as caught:
        parse_tles(text)
    assert type(caught.value) is kind
    return [f"{fault.where}: {fault.why}" for fault in caught.value.faults]


def test_every_element_is_the_one_that_sgp4_reads() -> None:
    tle = parse_tles(PLAIN)[0]
    satellite = Satrec.twoline2rv(LINE_1, LINE_2)
    assert np.radians(tle.inclination_deg) == pytest.approx(satellite.inclo, abs=1e-15)
    assert np.radians(tle.raan_deg) == pytest.approx(satellite.nodeo, abs=1e-15)
    assert np.radians(tle.argument_of_perigee_deg) == pytest.approx(satellite.argpo, abs=1e-15)
    assert np.radians(tle.mean_anomaly_deg) == pytest.approx(satellite.mo, abs=1e-15)
    assert tle.eccentricity == satellite.ecco
    assert tle.mean_motion_rev_day * 2 * np.pi / 1440 == pytest.approx(satellite.no_kozai, abs=1e-15)
    assert (tle.norad_id, tle.cospar_id, tle.name) == ("46493", "2020-068H", "")
    assert tle.epoch_utc == np.datetime64("2022-02-19T22:37:44.129568")
    assert tle.perigee_km == pytest.approx(6378.135 * (1 + satellite.altp), abs=1e-6)
    assert tle.apogee_km == pytest.approx(6378.135 * (1 + satellite.alta), abs=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        f"DEKART\n{PLAIN}",
        f"0 DEKART\n{PLAIN}",
        f"DEKART                  \n{PLAIN}",
        f"\ufeffDEKART\r\n{LINE_1}\r\n{LINE_2}\r\n",
        f"\n\nDEKART\n\n{LINE_1}   \n{LINE_2} \n\n",
        f"DEKART\r{LINE_1}\r{LINE_2}",
    ],
)
def test_three_line_forms_crlf_and_blanks_are_accepted(text: str) -> None:
    (tle,) = parse_tles(text)
    assert (tle.name, tle.line1, tle.line2) == ("DEKART", LINE_1, LINE_2)
    assert parse_tles(tle.text) == [tle]


def test_two_and_three_line_forms_may_be_mixed(data_dir: Path) -> None:
    text = PLAIN + (data_dir / "dekart.tle.txt").read_text() + PLAIN
    assert [tle.name for tle in parse_tles(text)] == ["", "DEKART 2022-02-19", "DEKART 2022-04-07", ""]


@pytest.mark.parametrize(
    ("written", "number"),
    [("A0000", 100000), ("B1234", 111234), ("J9999", 189999), ("P0001", 230001), ("Z9999", 339999)],
)
def test_alpha5_numbers_are_read(written: str, number: int) -> None:
    """The five published examples and ends of the ranges: I and O are left out."""
    text = f"{edited(LINE_1, 3, written)}\n{edited(LINE_2, 3, written)}\n"
    assert parse_tles(text)[0].norad_id == str(number)


def test_letters_i_and_o_are_not_alpha5() -> None:
    text = f"{edited(LINE_1, 3, 'I0000')}\n{edited(LINE_2, 3, 'I0000')}\n"
    assert [fault.split(":")[0] for fault in faults_of(text)] == ["line 1, column 3-7", "line 2, column 3-7"]


@pytest.mark.parametrize(
    ("year", "day", "epoch"),
    [
        ("57", "001.00000000", "1957-01-01"),
        ("56", "366.80000000", "2056-12-31T19:12"),
        ("99", "365.50000000", "1999-12-31T12:00"),
        ("00", "  1.00000001", "2000-01-01T00:00:00.000864"),
        ("20", "366.80000000", "2020-12-31T19:12"),
        ("21", "366.80000000", "2022-01-01T19:12"),
    ],
)
def test_epochs_count_days_from_the_first_of_january(year: str, day: str, epoch: str) -> None:
    """57 is 1957, 56 is 2056; in a common year day 366.8 is the first of January, as SGP4 itself counts."""
    line1 = edited(edited(LINE_1, 19, year), 21, day)
    tle = parse_tles(f"{line1}\n{LINE_2}\n")[0]
    assert tle.epoch_utc == np.datetime64(epoch)
    satellite = Satrec.twoline2rv(line1, LINE_2)
    days = (tle.epoch_utc - np.datetime64("1970-01-01", "ns")) / np.timedelta64(1, "D")
    assert satellite.jdsatepoch - 2440587.5 + satellite.jdsatepochF == pytest.approx(days, abs=1e-8)


@pytest.mark.parametrize("line", [1, 2])
def test_a_wrong_checksum_is_named_with_line_and_both_digits(line: int) -> None:
    lines = [LINE_1, LINE_2]
    right = lines[line - 1][68]
    lines[line - 1] = lines[line - 1][:68] + str((int(right) + 3) % 10)
    (fault,) = faults_of("\n".join(lines), TleChecksumError)
    assert fault.startswith(f"line {line}, column 69: checksum digit is {lines[line - 1][68]}")
    assert fault.endswith(f"sums to {right}")


@pytest.mark.parametrize(
    ("text", "where"),
    [
        (f"{LINE_1[:68]}\n{LINE_2}", "line 1, column 69: 68 columns"),
        (f"{LINE_1}\n{LINE_2}0", "line 2, column 70: 70 columns"),
        (f"{LINE_1}\n{LINE_2[:40]}", "line 2, column 41: 40 columns"),
        (f"{LINE_2}\n{LINE_1}", "line 1, column 1: line 2 stands before line 1: the lines are swapped"),
        (LINE_1, "line 1, column 1: line 1 of a TLE, but line 2 does not follow"),
        (LINE_2, "line 1, column 1: line 2 of a TLE, but there is no line 1"),
        (f"{LINE_1}\n{edited(LINE_2, 3, '46494')}", "line 2, column 3-7: catalogue number 46494 is not line 1's 46493"),
        (f"{LINE_1}\n{LINE_2.replace('  97', chr(0xA0) + ' 97')}", "line 2, column 8: non-breaking space"),
        (f"{LINE_1}\n{LINE_2.replace('  97', ' ' + chr(9) + '97')}", "line 2, column 9: tab"),
        (f"{LINE_1.replace('U ', 'Ü ')}\n{LINE_2}", "line 1, column 8: character U+00DC"),
        (f"{LINE_1.replace('46493U ', '46493U' + chr(0))}\n{LINE_2}", "line 1, column 9: character U+0000"),
        (f" {LINE_1}\n{LINE_2}", "line 1, column 70: 70 columns, want 69; the columns are wrong from 1 on"),
        (
            f"{LINE_1}\n{edited(LINE_2, 9, '197.7186')}",
            "line 2, column 9-16: inclination is 197.7186 deg, want 0 to 180",
        ),
        (
            f"{LINE_1}\n{edited(LINE_2, 18, '360.0001')}",
            "line 2, column 18-25: right ascension of the node is 360.0001",
        ),
        (f"{LINE_1}\n{edited(LINE_2, 35, '400.0000')}", "line 2, column 35-42: argument of perigee is 400.0"),
        (f"{LINE_1}\n{edited(LINE_2, 44, '999.9999')}", "line 2, column 44-51: mean anomaly is 999.9999"),
        (f"{LINE_1}\n{edited(LINE_2, 53, ' 0.00000000')}", "line 2, column 53-63: mean motion is 0.0 rev/day"),
        (f"{LINE_1}\n{edited(LINE_2, 53, '18.00000000')}", "line 2, column 53-63: mean motion 18.0 rev/day"),
        (f"{LINE_1}\n{edited(LINE_2, 27, '9000000')}", "line 2, column 53-63: mean motion 15.04187815 rev/day"),
        (f"{edited(LINE_1, 21, '000.50000000')}\n{LINE_2}", "line 1, column 21-32: epoch day is 0.5"),
        (f"{edited(LINE_1, 21, '367.00000000')}\n{LINE_2}", "line 1, column 21-32: epoch day is 367.0"),
        (f"{edited(LINE_1, 54, ' nan    ')}\n{LINE_2}", "line 1, column 54-61: B* is malformed"),
        (f"{edited(LINE_1, 63, '4')}\n{LINE_2}", "line 1, column 63: ephemeris type is 4"),
        (f"{LINE_1}\n{edited(LINE_2, 17, 'x')}", "line 2, column 17: want a blank"),
        ("hello\n" + PLAIN.replace("1 4", "x 4", 1), "line 1: neither a line of a TLE nor a name"),
        ("DEKART\n", "line 1: neither a line of a TLE nor a name"),
        ("A\x1b[2J\n" + PLAIN, "line 1, column 2: control character U+001B"),
        ("N" * 101 + "\n" + PLAIN, "line 1: name has 101 characters"),
        ("", "line 1: want two lines of 69 columns"),
    ],
)
def test_each_fault_is_named_with_line_and_column(text: str, where: str) -> None:
    assert faults_of(text)[0].startswith(where)


def test_all_faults_of_a_text_are_collected() -> None:
    bad = f"{LINE_1}\n{edited(LINE_2, 9, '197.7186')}\n"
    assert len(faults_of(PLAIN + bad * 150)) == 100
    assert faults_of(PLAIN + bad + PLAIN + bad)[1].startswith("line 8, column 9-16")


def test_a_checksum_beside_another_fault_is_a_format_error() -> None:
    wrong = LINE_1[:68] + "0"
    assert len(faults_of(f"{wrong}\n{edited(LINE_2, 9, '197.7186')}")) == 2


@given(st.text(max_size=200))
def test_no_text_breaks_the_parser(text: str) -> None:
    with pytest.raises(TleFormatError):
        parse_tles(text)


@given(st.integers(1, 2), st.integers(0, 68), st.characters())
def test_no_changed_character_passes_unless_the_line_still_sums(line: int, column: int, character: str) -> None:
    """The checksum cannot see letters; every other change of one character is refused, or means a line of its own."""
    lines = [LINE_1, LINE_2]
    old = lines[line - 1]
    lines[line - 1] = old[:column] + character + old[column + 1 :]
    if character in " \r\n" or lines[line - 1] == old:
        return
    try:
        parse_tles("\n".join(lines))
    except TleFormatError:
        return
    assert re.fullmatch("[A-Z0+.]", character)


def test_fifteen_hundred_tles_are_all_read() -> None:
    assert len(parse_tles(PLAIN * 1500)) == 1500

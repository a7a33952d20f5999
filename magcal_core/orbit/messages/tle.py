"""TLE and 3LE text, verified column by column before anything is propagated."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from sgp4.api import Satrec

from magcal_core.errors import Fault, TleChecksumError, TleFormatError

LINE_LENGTH: Final = 69
EARTH_RADIUS_SGP4_KM: Final = 6378.135
"""Equatorial radius of WGS-72, which SGP4 counts in, km (SGP4)."""

_KE: Final = 60.0 / np.sqrt(EARTH_RADIUS_SGP4_KM**3 / 398600.8)
_J2: Final = 0.001082616
_NS_PER_1E8_DAY: Final = 864_000
_ALPHA5: Final = "ABCDEFGHJKLMNPQRSTUVWXYZ"
_NAME_LIMIT: Final = 100


@dataclass(frozen=True, slots=True)
class Column:
    """One field of a TLE line: its columns, counted from 1, its name and what may stand there."""

    first: int
    last: int
    name: str
    pattern: re.Pattern[str]

    @property
    def where(self) -> str:
        """The columns as a person counts them."""
        return f"column {self.first}" if self.first == self.last else f"column {self.first}-{self.last}"

    def text(self, line: str) -> str:
        """Return what stands in these columns of ``line``."""
        return line[self.first - 1 : self.last]


def _columns(*rows: tuple[int, int, str, str]) -> dict[str, Column]:
    table = {name: Column(first, last, name, re.compile(pattern)) for first, last, name, pattern in rows}
    held = {column for c in table.values() for column in range(c.first, c.last + 1)}
    blanks = sorted(set(range(1, LINE_LENGTH + 1)) - held)
    return table | {f"blank {c}": Column(c, c, "blank", re.compile(" ")) for c in blanks}


_CATALOGUE: Final = rf" *\d+|[{_ALPHA5}]\d{{4}}"
_EXPONENTIAL: Final = r"[-+ ]\d{5}[-+]\d"
_ANGLE: Final = r" *\d+\.\d{4}"

LINE_1: Final = _columns(
    (1, 1, "line number", "1"),
    (3, 7, "catalogue number", _CATALOGUE),
    (8, 8, "classification", "[UCS ]"),
    (10, 17, "international designator", r"\d\d[\d ]{3}[A-Z ]{3}| {8}"),
    (19, 20, "epoch year", r"[\d ]\d"),
    (21, 32, "epoch day", r" *\d+\.\d{8}"),
    (34, 43, "first derivative of mean motion", r"[-+ ]\.\d{8}|[-+ ]?\d\.\d{7,8}"),
    (45, 52, "second derivative of mean motion", _EXPONENTIAL),
    (54, 61, "B*", _EXPONENTIAL),
    (63, 63, "ephemeris type", r"[\d ]"),
    (65, 68, "element set number", r" *\d+| {4}"),
    (69, 69, "checksum", r"\d"),
)
LINE_2: Final = _columns(
    (1, 1, "line number", "2"),
    (3, 7, "catalogue number", _CATALOGUE),
    (9, 16, "inclination", _ANGLE),
    (18, 25, "right ascension of the node", _ANGLE),
    (27, 33, "eccentricity", r" *\d+"),
    (35, 42, "argument of perigee", _ANGLE),
    (44, 51, "mean anomaly", _ANGLE),
    (53, 63, "mean motion", r" *\d+\.\d{8}"),
    (64, 68, "revolution number", r" *\d+| {5}"),
    (69, 69, "checksum", r"\d"),
)
_LIMITS_DEG: Final = {
    "inclination": 180.0,
    "right ascension of the node": 360.0,
    "argument of perigee": 360.0,
    "mean anomaly": 360.0,
}
_ELEMENT_LINE: Final = re.compile(r"\s*[12]\s")
_SHIFTED_LINE: Final = re.compile(r"\s+[12]\s+\d{5}")


@dataclass(frozen=True, slots=True)
class Tle:
    """One two-line element set whose every column has been verified.

    Attributes
    ----------
    name : str
        The name line, "" in the two-line form.
    line1, line2 : str
        69 columns each.
    norad_id : str
        Catalogue number as a decimal number, also where the TLE writes it as Alpha-5.
    cospar_id : str
        International designator such as ``2020-068H``, "" where the TLE has none.
    epoch_utc : datetime64[ns]
        Epoch, UTC.
    perigee_km, apogee_km : float
        Radii, from the Earth's centre, of the mean orbit at epoch, km.
    """

    name: str
    line1: str
    line2: str
    norad_id: str
    cospar_id: str
    epoch_utc: np.datetime64
    inclination_deg: float
    raan_deg: float
    eccentricity: float
    argument_of_perigee_deg: float
    mean_anomaly_deg: float
    mean_motion_rev_day: float
    perigee_km: float
    apogee_km: float

    @property
    def text(self) -> str:
        """The TLE as text, with its name line where it has a name."""
        lines = [self.name] if self.name else []
        return "\n".join([*lines, self.line1, self.line2]) + "\n"

    def satrec(self) -> Satrec:
        """Return the elements as `sgp4` wants them."""
        return Satrec.twoline2rv(self.line1, self.line2)


def parse_tles(text: str) -> list[Tle]:
    """Return every TLE of a text in the order they stand there: two- and three-line form, any number of them.

    Blank lines, CRLF, a byte order mark, ``0 NAME`` lines and blanks beyond column 69 are accepted.

    Raises
    ------
    TleChecksumError
        Only checksums are wrong; ``faults`` has the line of each.
    TleFormatError
        A column, a range, the order of the lines or a catalogue number is wrong, or there is no TLE at all;
        ``faults`` has line and column of each.
    """
    tles, faults = read_tles(text)
    if faults:
        kind = TleChecksumError if all(fault.why.startswith("checksum digit") for fault in faults) else TleFormatError
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise kind(f"TLE {faults[0].where}: {faults[0].why}{more}", faults)
    if not tles:
        raise TleFormatError("there is no TLE in the text", [Fault("line 1", "want two lines of 69 columns")])
    return tles


def read_tles(text: str) -> tuple[list[Tle], list[Fault]]:
    """Return the TLEs of a text that are whole, in their order, and every fault of what is not, with line and column.

    `parse_tles` is what refuses a text that has a fault.
    """
    faults: list[Fault] = []
    tles = [tle for group in _groups(text, faults) if (tle := _parse_group(group, faults)) is not None]
    return tles, faults


def checksum(line: str) -> int:
    """Return the checksum of columns 1 to 68: the sum of the digits, a minus sign counting 1, modulo 10."""
    body = line[: LINE_LENGTH - 1]
    return (sum(int(c) for c in body if c in "0123456789") + body.count("-")) % 10


@dataclass(frozen=True, slots=True)
class _Group:
    """A name and two lines, with the number of the first of the two in the text."""

    name: str
    line1: str
    line2: str
    number: int


def _groups(text: str, faults: list[Fault]) -> Iterator[_Group]:
    raw = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    lines = [(number, line) for number, line in enumerate(raw, 1) if line.strip()]
    name, i = "", 0
    while i < len(lines):
        number, line = lines[i]
        following = lines[i + 1] if i + 1 < len(lines) else (number + 1, "")
        match _kind(line):
            case "1" if _kind(following[1]) == "2":
                yield _Group(name, line, following[1], number)
                i, name = i + 2, ""
                continue
            case "2" if _kind(following[1]) == "1" and _number_of(line) == _number_of(following[1]):
                faults.append(Fault(f"line {number}, column 1", "line 2 stands before line 1: the lines are swapped"))
                i += 1
            case "1" | "2" as kind:
                missing = "line 2 does not follow" if kind == "1" else "there is no line 1 before it"
                faults.append(Fault(f"line {number}, column 1", f"line {kind} of a TLE, but {missing}"))
            case _:
                faults.extend(_name_faults(number, line, _kind(following[1])))
                name = re.sub(r"^0 ", "", line).strip()
                i += 1
                continue
        i, name = i + 1, ""


def _kind(line: str) -> str:
    if _ELEMENT_LINE.match(line) and (not line[0].isspace() or _SHIFTED_LINE.match(line)):
        return line.lstrip()[0]
    return "name" if line else "end"


def _number_of(line: str) -> str:
    return line[2:7]


def _name_faults(number: int, line: str, following: str) -> list[Fault]:
    where = f"line {number}"
    faults = []
    if following != "1":
        faults.append(Fault(where, "neither a line of a TLE nor a name that a line 1 follows", line[:80]))
    if bad := [c for c in line.rstrip() if not c.isprintable()]:
        faults.append(Fault(f"{where}, column {line.index(bad[0]) + 1}", f"control character U+{ord(bad[0]):04X}"))
    if len(line.strip()) > _NAME_LIMIT:
        faults.append(Fault(where, f"name has {len(line.strip())} characters; at most {_NAME_LIMIT}"))
    return faults


def _parse_group(group: _Group, faults: list[Fault]) -> Tle | None:
    first, second = group.line1.rstrip(" "), group.line2.rstrip(" ")
    numbers = (group.number, group.number + 1)
    found = [*_line_faults(numbers[0], first, LINE_1), *_line_faults(numbers[1], second, LINE_2)]
    if not any(not fault.why.startswith("checksum digit") for fault in found):
        one, two = _catalogue_number(first), _catalogue_number(second)
        if one != two:
            found.append(Fault(f"line {numbers[1]}, column 3-7", f"catalogue number {two} is not line 1's {one}"))
        found.extend(_range_faults(numbers, first, second))
    faults.extend(found)
    return None if found else _tle(group.name, first, second)


def _line_faults(number: int, line: str, columns: dict[str, Column]) -> Sequence[Fault]:
    where = f"line {number}"
    strange = [(i, c) for i, c in enumerate(line, 1) if not " " <= c <= "~"]
    if strange:
        return [
            Fault(f"{where}, column {i}", f"{_character(c)}; a TLE has printable ASCII and blanks only", c)
            for i, c in strange
        ]
    wrong = [c for c in columns.values() if not c.pattern.fullmatch(c.text(line))]
    if len(line) != LINE_LENGTH:
        start = min((c.first for c in wrong), default=LINE_LENGTH)
        broken = f"; the columns are wrong from {start} on" if start <= min(len(line), LINE_LENGTH) else ""
        return [Fault(f"{where}, column {min(len(line), LINE_LENGTH) + 1}", f"{len(line)} columns, want 69{broken}")]
    if wrong:
        return [
            Fault(
                f"{where}, {c.where}", f"{c.name} is malformed" if c.name != "blank" else "want a blank", c.text(line)
            )
            for c in sorted(wrong, key=lambda c: c.first)
        ]
    want = checksum(line)
    if line[-1] != str(want):
        return [Fault(f"{where}, column 69", f"checksum digit is {line[-1]}, the line sums to {want}")]
    return []


def _character(character: str) -> str:
    known = {
        "\t": "tab",
        "\u00a0": "non-breaking space",
        "\u202f": "narrow non-breaking space",
        "\ufeff": "byte order mark",
    }
    return known.get(character, f"character U+{ord(character):04X}")


def _range_faults(numbers: tuple[int, int], line1: str, line2: str) -> list[Fault]:
    faults = []
    day = float(LINE_1["epoch day"].text(line1))
    if not 1.0 <= day < 367.0:
        faults.append(Fault(f"line {numbers[0]}, column 21-32", f"epoch day is {day}, want 1 to 366.99999999"))
    if LINE_1["ephemeris type"].text(line1) == "4":
        faults.append(Fault(f"line {numbers[0]}, column 63", "ephemeris type is 4, SGP4-XP; SGP4 cannot propagate it"))
    for name, limit_deg in _LIMITS_DEG.items():
        angle_deg = float(LINE_2[name].text(line2))
        if angle_deg > limit_deg:
            where = f"line {numbers[1]}, {LINE_2[name].where}"
            faults.append(Fault(where, f"{name} is {angle_deg} deg, want 0 to {limit_deg:g} deg"))
    return faults + _motion_faults(numbers[1], line2)


def _motion_faults(number: int, line2: str) -> list[Fault]:
    column = LINE_2["mean motion"]
    motion_rev_day = float(column.text(line2))
    if motion_rev_day <= 0.0:
        return [Fault(f"line {number}, {column.where}", f"mean motion is {motion_rev_day} rev/day, want more than 0")]
    eccentricity = _eccentricity(line2)
    perigee_km, _ = apsides_km(motion_rev_day, eccentricity, float(LINE_2["inclination"].text(line2)))
    if perigee_km < EARTH_RADIUS_SGP4_KM:
        why = (
            f"mean motion {motion_rev_day} rev/day with eccentricity {eccentricity} puts the perigee "
            f"{EARTH_RADIUS_SGP4_KM - perigee_km:.0f} km below the ground"
        )
        return [Fault(f"line {number}, {column.where}", why)]
    return []


def apsides_km(motion_rev_day: float, eccentricity: float, inclination_deg: float) -> tuple[float, float]:
    """Return the radii of perigee and apogee, km, from Kozai's mean motion of the TLE (SGP4, initl)."""
    kozai = motion_rev_day * 2.0 * np.pi / 1440.0
    cosine = np.cos(np.radians(inclination_deg))
    oblateness = 0.75 * _J2 * (3.0 * cosine**2 - 1.0) / (1.0 - eccentricity**2) ** 1.5
    start = (_KE / kozai) ** (2.0 / 3.0)
    d = oblateness / start**2
    d = oblateness / (start * (1.0 - d * d - d * (1.0 / 3.0 + 134.0 * d * d / 81.0))) ** 2
    axis_km = (_KE / (kozai / (1.0 + d))) ** (2.0 / 3.0) * EARTH_RADIUS_SGP4_KM
    return float(axis_km * (1.0 - eccentricity)), float(axis_km * (1.0 + eccentricity))


def _eccentricity(line2: str) -> float:
    return float(f"0.{LINE_2['eccentricity'].text(line2).replace(' ', '0')}")


def _catalogue_number(line: str) -> int:
    text = LINE_1["catalogue number"].text(line)
    return int(text) if text.strip().isdigit() else (10 + _ALPHA5.index(text[0])) * 10000 + int(text[1:])


def _full_year(two_digits: int) -> int:
    """Return the year of a two-digit one: 57 is 1957, 56 is 2056."""
    return two_digits + (1900 if two_digits >= 57 else 2000)


def _epoch(line1: str) -> np.datetime64:
    whole, fraction = LINE_1["epoch day"].text(line1).split(".")
    start = np.datetime64(f"{_full_year(int(LINE_1['epoch year'].text(line1)))}-01-01", "ns")
    days = np.timedelta64(int(whole) - 1, "D")
    return np.datetime64(start + days + np.timedelta64(int(fraction) * _NS_PER_1E8_DAY, "ns"))


def _cospar_id(line1: str) -> str:
    text = LINE_1["international designator"].text(line1)
    if not text.strip():
        return ""
    return f"{_full_year(int(text[:2]))}-{text[2:5].strip().zfill(3)}{text[5:].strip()}"


def _tle(name: str, line1: str, line2: str) -> Tle:
    motion_rev_day, eccentricity = float(LINE_2["mean motion"].text(line2)), _eccentricity(line2)
    inclination_deg = float(LINE_2["inclination"].text(line2))
    perigee_km, apogee_km = apsides_km(motion_rev_day, eccentricity, inclination_deg)
    return Tle(
        name=name,
        line1=line1,
        line2=line2,
        norad_id=str(_catalogue_number(line1)),
        cospar_id=_cospar_id(line1),
        epoch_utc=_epoch(line1),
        inclination_deg=inclination_deg,
        raan_deg=float(LINE_2["right ascension of the node"].text(line2)),
        eccentricity=eccentricity,
        argument_of_perigee_deg=float(LINE_2["argument of perigee"].text(line2)),
        mean_anomaly_deg=float(LINE_2["mean anomaly"].text(line2)),
        mean_motion_rev_day=motion_rev_day,
        perigee_km=perigee_km,
        apogee_km=apogee_km,
    )

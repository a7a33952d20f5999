"""Epochs as orbit messages write them: calendar or day of year, in UTC or another time system of CCSDS."""

from __future__ import annotations

import re
from typing import Final

import erfa
import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Times
from magcal_core.errors import TimeError, TimeZoneMissingError
from magcal_core.orbit.earth.timescales import TT_MINUS_TAI_S, julian_tt, tai_minus_utc_s

TIME_SYSTEMS: Final = ("UTC", "TAI", "GPS", "TT", "TDB")
"""Time systems that epochs may be in."""

_CALENDAR: Final = re.compile(r"(\d{4}-\d{2}-\d{2})[T ](\d{2}):(\d{2}):(\d{2})(?:\.(\d{1,18}))?(Z|[+-]\d{2}:?\d{2})?")
_DAY_OF_YEAR: Final = re.compile(r"(\d{4})-(\d{3})T(\d{2}):(\d{2}):(\d{2})(?:\.(\d{1,18}))?(Z?)")
FIRST_YEAR: Final = 1900
LAST_YEAR: Final = 2199
"""Years whose nanoseconds a datetime64 holds, with room for offsets."""
_GPS_MINUS_TAI_S: Final = -19.0


def parse_epoch(text: str, *, needs_zone: bool = False) -> np.datetime64:
    """Return the epoch in ``text``, calendar or day-of-year form, to the nanosecond; a zone's offset is taken off.

    Raises
    ------
    TimeZoneMissingError
        A zone is wanted and there is none.
    TimeError
        The text is not an epoch.
    """
    text = text.strip().upper()
    if match := _CALENDAR.fullmatch(text):
        day, *clock, zone = match.groups()
    elif match := _DAY_OF_YEAR.fullmatch(text):
        year, number, *clock, zone = match.groups()
        if not 1 <= int(number) <= 366:
            raise TimeError(f"{text!r}: day {number} is not a day of the year")
        day = str(np.datetime64(f"{year}-01-01") + np.timedelta64(int(number) - 1, "D"))
    else:
        raise TimeError(f"{text[:40]!r} is not an epoch such as 2022-02-19T22:37:44.130Z")
    if needs_zone and not zone:
        raise TimeZoneMissingError(f"{text!r} has no zone; append Z where it is UTC")
    if not FIRST_YEAR <= int(day[:4]) <= LAST_YEAR:
        raise TimeError(f"{text!r} is outside the years {FIRST_YEAR} to {LAST_YEAR}")
    hour, minute, second = (int(part) for part in clock[:3])
    if hour > 23 or minute > 59 or second > 59:
        raise TimeError(f"{text!r} is not a time of day (leap seconds cannot be epochs)")
    nanosecond = int((clock[3] or "0")[:9].ljust(9, "0"))
    try:
        midnight = np.datetime64(day, "ns")
    except ValueError as error:
        raise TimeError(f"{text!r}: there is no day {day}") from error
    seconds = np.timedelta64(hour * 3600 + minute * 60 + second - _offset_s(zone), "s")
    return np.datetime64(midnight + seconds + np.timedelta64(nanosecond, "ns"))


def _offset_s(zone: str | None) -> int:
    if not zone or zone == "Z":
        return 0
    digits = zone[1:].replace(":", "")
    seconds = int(digits[:2]) * 3600 + int(digits[2:]) * 60
    return -seconds if zone[0] == "-" else seconds


def to_utc(epochs: Times, time_system: str) -> Times:
    """Return epochs of one of `TIME_SYSTEMS`, shape (n,), in UTC.

    Raises
    ------
    TimeError
        The time system is another one.
    """
    if time_system == "UTC":
        return epochs
    if time_system not in TIME_SYSTEMS:
        raise TimeError(f"time system {time_system!r} cannot be converted; known are {', '.join(TIME_SYSTEMS)}")
    ahead_of_tai_s = {"TAI": 0.0, "GPS": _GPS_MINUS_TAI_S, "TT": TT_MINUS_TAI_S, "TDB": TT_MINUS_TAI_S}[time_system]
    tai = epochs - np.timedelta64(round(ahead_of_tai_s * 1e9), "ns")
    utc = tai - _seconds(tai_minus_utc_s(tai))
    utc = tai - _seconds(tai_minus_utc_s(utc))
    if time_system == "TDB":
        utc = utc - _seconds(np.asarray(erfa.dtdb(*julian_tt(utc), 0.0, 0.0, 0.0, 0.0)))
    return np.asarray(utc, "datetime64[ns]")


def _seconds(seconds: NDArray[np.float64]) -> NDArray[np.timedelta64]:
    return np.rint(seconds * 1e9).astype("timedelta64[ns]")

"""Times written as a year and the day in it, with or without a time of day, in nanoseconds since 1970."""

from __future__ import annotations

import re
from datetime import date, timedelta
from typing import Final

from magcal_core.errors import TimeError

_NS: Final = 1_000_000_000
_DAY: Final = 86_400 * _NS
_YEAR_DAY: Final = re.compile(
    r"(\d{4})[-/:. ]?(\d{3})(?:[T/:. -]+(\d{1,2})[:. -](\d{2})(?:[:. -](\d{2})(?:[.,](\d{1,18}))?)?)?\s*(?:Z|UTC)?",
    re.ASCII | re.IGNORECASE,
)
_PACKED: Final = re.compile(r"(\d{7}|\d{5}|\d{1,3})(?:[.,](\d{1,18}))?", re.ASCII)
_CLOCK: Final = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,18}))?)?\s*(?:Z|UTC)?", re.ASCII | re.IGNORECASE)
_SEVENTY: Final = 57
"""Two-digit years below it are of this century, as in a TLE."""


def day_of_year_ns(text: str, year: int | None) -> int:
    """Return a time of year and day: with separators, or packed as YYYYDDD, YYDDD or, in a known year, DDD."""
    if match := _PACKED.fullmatch(text):
        digits, fraction = match[1], match[2] or ""
        if len(digits) == 7:
            of, day = int(digits[:4]), int(digits[4:])
        elif len(digits) == 5:
            of, day = int(digits[:2]) + (2000 if int(digits[:2]) < _SEVENTY else 1900), int(digits[2:])
        elif year is None:
            raise TimeError("a day of the year without a year: --time-epoch gives it, or a column year")
        else:
            of, day = year, int(digits)
        return _midnight_ns(of, day) + _fraction_ns(fraction, _DAY)
    match = _YEAR_DAY.fullmatch(text)
    if match is None:
        raise TimeError("not a year and a day such as 2022-050T22:37:44, 2022:050:22:37:44 or 2022050.943")
    clock = tuple(match[i] or "0" for i in range(3, 7))
    return _midnight_ns(int(match[1]), int(match[2])) + _clock_ns(*clock)


def year_and_day_ns(text: str) -> int:
    """Return the time in the columns year, day of the year and, where there is one, time of day."""
    year, day, *rest = text.split(" ", 2)
    whole, _, fraction = day.replace(",", ".").partition(".")
    since_ns = _midnight_ns(int(float(year)), int(whole)) + _fraction_ns(fraction, _DAY)
    if not rest:
        return since_ns
    if match := _CLOCK.fullmatch(rest[0].strip()):
        return since_ns + _clock_ns(*(match[i] or "0" for i in range(1, 5)))
    seconds, _, fraction = rest[0].replace(",", ".").partition(".")
    return since_ns + int(seconds) * _NS + _fraction_ns(fraction, _NS)


def _midnight_ns(year: int, day: int) -> int:
    if not 1 <= day <= 366 or not 1900 <= year <= 2199:
        raise TimeError(f"there is no day {day} of the year {year}")
    return ((date(year, 1, 1) + timedelta(days=day - 1)) - date(1970, 1, 1)).days * _DAY


def _clock_ns(hour: str, minute: str, second: str, fraction: str) -> int:
    if int(hour) > 23 or int(minute) > 59 or int(second) > 60:
        raise TimeError("there is no such time of day")
    return (int(hour) * 3600 + int(minute) * 60 + int(second)) * _NS + _fraction_ns(fraction, _NS)


def _fraction_ns(digits: str, unit_ns: int) -> int:
    return int(int(digits) * unit_ns / 10 ** len(digits) + 0.5) if digits else 0

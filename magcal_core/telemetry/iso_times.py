"""Times in ISO 8601 with a zone, in nanoseconds UTC, and the span of years that telemetry may have."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime, time, timedelta, timezone
from typing import Final

import numpy as np

from magcal_core.errors import TimeError, TimeZoneMissingError

Spans = tuple[tuple[np.datetime64, np.datetime64], ...]
"""Stretches of time, UTC, in which the available orbits are good."""

NO_TIME: Final = int(np.iinfo(np.int64).min)
"""Stands for a missing time; the bit pattern of NaT."""
EARLIEST_NS: Final = int(np.datetime64("1972-01-01", "ns").astype(np.int64))
"""UTC with leap seconds begins in 1972; earlier times are clocks that were never set."""
LATEST_NS: Final = int(np.datetime64("2100-01-01", "ns").astype(np.int64))
LAST_NS: Final = int(np.iinfo(np.int64).max)

_NS: Final = 1_000_000_000
_CLOCK: Final = r"(?P<hour>\d\d)(?::?(?P<minute>\d\d)(?::?(?P<second>\d\d)(?:[.,](?P<fraction>\d{1,18}))?)?)"
_ZONE: Final = r"\s*(?P<zone>Z|UTC|GMT|[+-]\d\d(?::?\d\d)?)?"
_EXTENDED: Final = (
    r"(?P<year>\d{4})-(?:(?P<month>\d\d)-(?P<day>\d\d)|(?P<ordinal>\d{3})|W(?P<week>\d\d)-(?P<weekday>[1-7]))"
)
_BASIC: Final = r"(?P<year>\d{4})(?:(?P<month>\d\d)(?P<day>\d\d)|(?P<ordinal>\d{3})|W(?P<week>\d\d)(?P<weekday>[1-7]))"
_ISO: Final = re.compile(_EXTENDED + "[T ]" + _CLOCK + _ZONE, re.ASCII | re.IGNORECASE)
_ISO_BASIC: Final = re.compile(_BASIC + "T" + _CLOCK + _ZONE, re.ASCII | re.IGNORECASE)
"""Calendar, ordinal and week dates of ISO 8601."""
_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def is_number(text: str) -> bool:
    """Return whether ``text`` is a plain decimal number."""
    return _NUMBER.fullmatch(text) is not None


def parse_iso_time(text: str) -> np.datetime64:
    """Return an ISO 8601 time with a zone in UTC; one that nanoseconds cannot count is the nearest that they can.

    They count from 1677 to 2262. Errors are those of `parse_iso_ns`.
    """
    return np.datetime64(min(max(parse_iso_ns(text), -LAST_NS), LAST_NS), "ns")


def parse_iso_ns(text: str, *, is_utc: bool = False) -> int:
    """Return the nanoseconds since 1970, UTC, of an ISO 8601 time with a zone; a leap second counts as the next second.

    The date is of the calendar, of the year (``2022-050``) or of the week (``2022-W07-6``), with separators or
    without. ``is_utc`` says that a time without a zone is UTC.

    Raises
    ------
    TimeZoneMissingError
        The time has no zone.
    TimeError
        The text is not an ISO 8601 time, or the date does not exist.
    """
    match = iso_match(text)
    if match is None:
        raise TimeError("not an ISO 8601 time with a zone, nor seconds since 1970-01-01")
    second, fraction, zone = int(match["second"] or 0), match["fraction"] or "", match["zone"]
    if zone is None and not is_utc:
        raise TimeZoneMissingError("a time without a zone; append Z or an offset such as +02:00")
    is_leap = second == 60
    try:
        clock = time(
            int(match["hour"]), int(match["minute"] or 0), 59 if is_leap else second, tzinfo=_zone(zone or "Z")
        )
        whole = datetime.combine(_date(match), clock).astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise TimeError(f"no such time: {error}") from error
    if is_leap:
        if not _may_be_leap_second(whole):
            raise TimeError("second 60 exists only at the end of June or December, at 23:59 UTC")
        whole += timedelta(seconds=1)
    seconds = (whole - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(seconds=1)
    return seconds * _NS + int(fraction[:9].ljust(9, "0"))


def iso_match(text: str) -> re.Match[str] | None:
    """Return the parts of a text that has the form of an ISO 8601 time."""
    plain = text.strip()
    return _ISO.fullmatch(plain) or _ISO_BASIC.fullmatch(plain)


def _date(match: re.Match[str]) -> date:
    year = int(match["year"])
    if match["ordinal"]:
        found = date(year, 1, 1) + timedelta(days=int(match["ordinal"]) - 1)
        if found.year != year:
            raise ValueError("day of the year must be in 1..365, or 366")
        return found
    if match["week"]:
        return date.fromisocalendar(year, int(match["week"]), int(match["weekday"]))
    return date(year, int(match["month"]), int(match["day"]))


def _zone(text: str) -> timezone:
    if text.upper() in ("Z", "UTC", "GMT"):
        return UTC
    minutes = int(text[1:3]) * 60 + int(text[3:].lstrip(":") or 0)
    if int(text[3:].lstrip(":") or 0) > 59:
        raise ValueError("zone minutes must be in 0..59")
    return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))


def _may_be_leap_second(last: datetime) -> bool:
    return (last.hour, last.minute) == (23, 59) and (last.month, last.day) in {(6, 30), (12, 31)}

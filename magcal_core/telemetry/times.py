"""Times of telemetry: ISO 8601 with a zone or seconds since an epoch, checked, in nanoseconds UTC."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime, time, timedelta, timezone
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Nanoseconds
from magcal_core.errors import InputError, OptionError, TimeError, TimeZoneMissingError
from magcal_core.telemetry.faults import FaultList

Spans = tuple[tuple[np.datetime64, np.datetime64], ...]
"""Stretches of time, UTC, in which the orbits at hand are good."""

NO_TIME: Final = int(np.iinfo(np.int64).min)
"""Stands for a missing time; the bit pattern of NaT."""
EARLIEST_NS: Final = int(np.datetime64("1972-01-01", "ns").astype(np.int64))
"""UTC with leap seconds begins in 1972; earlier times are clocks that were never set."""
LATEST_NS: Final = int(np.datetime64("2100-01-01", "ns").astype(np.int64))
TIME_SCALES: Final = ("utc", "gps")
"""Scales that telemetry may declare; with ``gps``, numbers are seconds since 1980-01-06."""

_GPS_EPOCH_NS: Final = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_GPS_MINUS_TAI_S: Final = -19
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


def parse_time_ns(text: str, *, is_epoch: bool, spans: Spans = ()) -> int:
    """Return the nanoseconds of one time cell in a column of epoch seconds or of ISO 8601 times.

    Epoch seconds count from whatever epoch their scale has; `to_utc_ns` moves them.

    Raises
    ------
    TimeError
        The cell is neither, or is of the other kind than its column.
    """
    if is_number(text) != is_epoch and (is_number(text) or iso_match(text)):
        kinds = ("an ISO 8601 time", "epoch seconds") if is_epoch else ("epoch seconds", "ISO 8601 times")
        raise TimeError(f"{kinds[0]} in a column of {kinds[1]}")
    if not is_epoch:
        return parse_iso_ns(text)
    if not is_number(text):
        raise TimeError("not seconds since 1970-01-01")
    return int(epoch_ns(np.array([float(text)]), spans)[0])


def parse_times(cells: list[tuple[str, str | None]], faults: FaultList, spans: Spans = ()) -> Nanoseconds:
    """Return the nanoseconds of ``cells``, pairs of place and text; empty cells have `NO_TIME`, faults are noted.

    ``spans`` is where the orbits are good: of a time that cannot be read the forms that put it there are named.
    """
    first = next((text for _, text in cells if text), "")
    is_epoch = is_number(first)
    t_ns = np.full(len(cells), NO_TIME, np.int64)
    for i, (where, text) in enumerate(cells):
        if not text:
            continue
        try:
            t_ns[i] = parse_time_ns(text, is_epoch=is_epoch, spans=spans)
        except OverflowError:
            faults.add(TimeError, where, "outside the years 1972 to 2099", text)
        except InputError as error:
            faults.add(type(error), where, error.message, text)
            if faults.count == 1:
                faults.advise(_advice(error, text, spans))
    return t_ns


def _advice(error: InputError, text: str, spans: Spans) -> str:
    if isinstance(error, TimeZoneMissingError):
        return "where such times are UTC: --time-format utc"
    if iso_match(text) is not None or is_number(text):
        return ""
    from magcal_core.telemetry.time_guesses import on_text

    return on_text(text, spans)


def epoch_ns(seconds: NDArray[np.floating] | NDArray[np.integer], spans: Spans = ()) -> Nanoseconds:
    """Return ``seconds`` since an epoch in nanoseconds, floats rounded to the microsecond; not finite gives `NO_TIME`.

    Raises
    ------
    TimeError
        The numbers are no seconds since 1970; the message has the forms that they may have.
    """
    values = np.asarray(seconds, np.float64)
    is_given = np.isfinite(values)
    given = values[is_given]
    if given.size:
        _refuse_other_forms(float(np.median(given)), spans)
    t_ns = np.full(values.shape, NO_TIME, np.int64)
    limited = np.clip(given, -9.2e9, 9.2e9)
    whole = np.floor(limited)
    micros = np.rint((limited - whole) * 1e6)
    t_ns[is_given] = whole.astype(np.int64) * _NS + micros.astype(np.int64) * 1000
    return t_ns


def _refuse_other_forms(typical: float, spans: Spans) -> None:
    if 0 <= typical * _NS < LATEST_NS and typical > 1e7:
        return
    from magcal_core.telemetry.time_guesses import on_number

    guess = on_number(typical, spans)
    raise TimeError(
        f"the times are no seconds since 1970-01-01 between 1972 and 2099 (a typical one is {typical:.15g})"
        + (f": {guess}" if guess else "")
    )


def to_utc_ns(t_ns: Nanoseconds, *, time_scale: str, is_epoch: bool) -> Nanoseconds:
    """Return times of the declared scale in UTC.

    Raises
    ------
    OptionError
        The scale is not one of `TIME_SCALES`.
    """
    if time_scale not in TIME_SCALES:
        raise OptionError(f"unknown time scale {time_scale!r}; known are {', '.join(TIME_SCALES)}")
    if time_scale == "utc":
        return t_ns
    import erfa

    is_given = t_ns != NO_TIME
    gps_ns = t_ns[is_given] + (_GPS_EPOCH_NS if is_epoch else 0)
    table = erfa.leap_seconds.get()
    begins = np.array([int(np.datetime64(date(row["year"], row["month"], 1), "ns").astype(np.int64)) for row in table])
    tai_minus_utc_s = np.asarray(table["tai_utc"], np.float64)
    # A step takes effect at a UTC instant; on the GPS scale that instant is late by the new difference.
    gps_minus_utc_ns = ((tai_minus_utc_s + _GPS_MINUS_TAI_S) * _NS).astype(np.int64)
    step = np.searchsorted(begins + gps_minus_utc_ns, gps_ns, side="right") - 1
    utc_ns = t_ns.copy()
    utc_ns[is_given] = gps_ns - gps_minus_utc_ns[np.maximum(step, 0)]
    return utc_ns


def check_plausible(t_ns: Nanoseconds, faults: FaultList) -> None:
    """Note every time outside 1972 to 2099."""
    if t_ns.size and t_ns.min() >= EARLIEST_NS and t_ns.max() < LATEST_NS:
        return
    is_odd = (t_ns != NO_TIME) & ((t_ns < EARLIEST_NS) | (t_ns >= LATEST_NS))
    for row in np.flatnonzero(is_odd):
        faults.add(
            TimeError,
            f"row {row + 1}, column time",
            "outside the years 1972 to 2099",
            np.datetime64(int(t_ns[row]), "ns"),
        )

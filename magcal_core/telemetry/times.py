"""Times of telemetry: ISO 8601 with a zone or seconds since an epoch, checked, in nanoseconds UTC."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime, timedelta, timezone
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Nanoseconds
from magcal_core.errors import InputError, OptionError, TimeError, TimeZoneMissingError
from magcal_core.telemetry.faults import FaultList

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
_ISO: Final = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[T ](\d\d):(\d\d)(?::(\d\d)(?:[.,](\d{1,18}))?)?\s*(Z|[+-]\d\d(?::?\d\d)?)?", re.ASCII | re.I
)
_NUMBER: Final = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_OTHER_UNITS: Final[dict[str, tuple[float, float]]] = {
    # name: (seconds in one, zero point in seconds since 1970)
    "milliseconds since 1970": (1e-3, 0.0),
    "microseconds since 1970": (1e-6, 0.0),
    "nanoseconds since 1970": (1e-9, 0.0),
    "Julian days": (86400.0, -2440587.5 * 86400.0),
    "modified Julian days": (86400.0, -40587.0 * 86400.0),
    "days since 1970": (86400.0, 0.0),
}


def is_number(text: str) -> bool:
    """Return whether ``text`` is a plain decimal number."""
    return _NUMBER.fullmatch(text) is not None


def parse_iso_ns(text: str) -> int:
    """Return the nanoseconds since 1970, UTC, of an ISO 8601 time with a zone; a leap second counts as the next second.

    Raises
    ------
    TimeZoneMissingError
        The time has no zone.
    TimeError
        The text is not an ISO 8601 time, or the date does not exist.
    """
    match = _ISO.fullmatch(text.strip())
    if match is None:
        raise TimeError("not an ISO 8601 time with a zone, nor seconds since 1970-01-01")
    year, month, day, hour, minute = (int(match[i]) for i in range(1, 6))
    second, fraction, zone = int(match[6] or 0), match[7] or "", match[8]
    if zone is None:
        raise TimeZoneMissingError("a time without a zone; append Z or an offset such as +02:00")
    is_leap = second == 60
    try:
        whole = datetime(year, month, day, hour, minute, 59 if is_leap else second, tzinfo=_zone(zone)).astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise TimeError(f"no such time: {error}") from error
    if is_leap:
        if not _may_be_leap_second(whole):
            raise TimeError("second 60 exists only at the end of June or December, at 23:59 UTC")
        whole += timedelta(seconds=1)
    seconds = (whole - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(seconds=1)
    return seconds * _NS + int(fraction[:9].ljust(9, "0"))


def _zone(text: str) -> timezone:
    if text in "Zz":
        return UTC
    minutes = int(text[1:3]) * 60 + int(text[3:].lstrip(":") or 0)
    if int(text[3:].lstrip(":") or 0) > 59:
        raise ValueError("zone minutes must be in 0..59")
    return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))


def _may_be_leap_second(last: datetime) -> bool:
    return (last.hour, last.minute) == (23, 59) and (last.month, last.day) in {(6, 30), (12, 31)}


def parse_time_ns(text: str, *, is_epoch: bool) -> int:
    """Return the nanoseconds of one time cell in a column of epoch seconds or of ISO 8601 times.

    Epoch seconds count from whatever epoch their scale has; `to_utc_ns` moves them.

    Raises
    ------
    TimeError
        The cell is neither, or is of the other kind than its column.
    """
    if is_number(text) != is_epoch and (is_number(text) or _ISO.fullmatch(text)):
        kinds = ("an ISO 8601 time", "epoch seconds") if is_epoch else ("epoch seconds", "ISO 8601 times")
        raise TimeError(f"{kinds[0]} in a column of {kinds[1]}")
    if not is_epoch:
        return parse_iso_ns(text)
    if not is_number(text):
        raise TimeError("not seconds since 1970-01-01")
    return int(epoch_ns(np.array([float(text)]))[0])


def parse_times(cells: list[tuple[str, str | None]], faults: FaultList) -> Nanoseconds:
    """Return the nanoseconds of ``cells``, pairs of place and text; empty cells have `NO_TIME`, faults are noted."""
    first = next((text for _, text in cells if text), "")
    is_epoch = is_number(first)
    t_ns = np.full(len(cells), NO_TIME, np.int64)
    for i, (where, text) in enumerate(cells):
        if not text:
            continue
        try:
            t_ns[i] = parse_time_ns(text, is_epoch=is_epoch)
        except OverflowError:
            faults.add(TimeError, where, "outside the years 1972 to 2099", text)
        except InputError as error:
            faults.add(type(error), where, error.message, text)
    return t_ns


def epoch_ns(seconds: NDArray[np.floating] | NDArray[np.integer]) -> Nanoseconds:
    """Return ``seconds`` since an epoch in nanoseconds, floats rounded to the microsecond; not finite gives `NO_TIME`.

    Raises
    ------
    TimeError
        The numbers are no seconds since 1970; the message has the unit that they seem to have.
    """
    values = np.asarray(seconds, np.float64)
    is_given = np.isfinite(values)
    given = values[is_given]
    if given.size:
        _refuse_other_units(float(np.median(given)))
    t_ns = np.full(values.shape, NO_TIME, np.int64)
    limited = np.clip(given, -9.2e9, 9.2e9)
    whole = np.floor(limited)
    micros = np.rint((limited - whole) * 1e6)
    t_ns[is_given] = whole.astype(np.int64) * _NS + micros.astype(np.int64) * 1000
    return t_ns


def _refuse_other_units(typical: float) -> None:
    if 0 <= typical * _NS < LATEST_NS and typical > 1e7:
        return
    for name, (scale_s, zero_s) in _OTHER_UNITS.items():
        if EARLIEST_NS <= (typical * scale_s + zero_s) * _NS < LATEST_NS:
            raise TimeError(f"the times look like {name} (a typical one is {typical:.15g}); send seconds or ISO 8601")
    raise TimeError(
        f"the times are no seconds since 1970-01-01 between 1972 and 2099 (a typical one is {typical:.15g})"
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

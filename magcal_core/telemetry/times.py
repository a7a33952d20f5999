"""Times of telemetry: ISO 8601 with a zone or seconds since an epoch, checked, in nanoseconds UTC."""

from __future__ import annotations

from datetime import date
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Nanoseconds
from magcal_core.errors import InputError, OptionError, TimeError, TimeZoneMissingError
from magcal_core.telemetry.faults import FaultList
from magcal_core.telemetry.iso_times import (
    EARLIEST_NS,
    LATEST_NS,
    NO_TIME,
    Spans,
    is_number,
    iso_match,
    parse_iso_ns,
)
from magcal_core.telemetry.time_guesses import on_number, on_text
from magcal_core.units import TIME_SCALES

_GPS_EPOCH_NS: Final = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_MINUS_TAI_NS: Final = {"gps": -19_000_000_000, "tai": 0, "tt": 32_184_000_000}
_NS: Final = 1_000_000_000


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
    guess = on_number(typical, spans)
    raise TimeError(
        f"the times are no seconds since 1970-01-01 between 1972 and 2099 (a typical one is {typical:.15g})"
        + (f": {guess}" if guess else "")
    )


def to_utc_ns(t_ns: Nanoseconds, *, time_scale: str, is_epoch: bool) -> Nanoseconds:
    """Return times of the declared scale in UTC; ``is_epoch``: numbers, which of GPS count from 1980-01-06.

    Raises
    ------
    OptionError
        The scale is not one of `TIME_SCALES`.
    """
    if time_scale not in TIME_SCALES:
        raise OptionError(f"unknown time scale {time_scale!r}; known are {', '.join(TIME_SCALES)}")
    if time_scale == "utc":
        return t_ns
    counts_from_gps = is_epoch and time_scale == "gps"
    return in_utc_ns(t_ns + np.where(t_ns == NO_TIME, 0, _GPS_EPOCH_NS) if counts_from_gps else t_ns, time_scale)


def in_utc_ns(t_ns: Nanoseconds, scale: str) -> Nanoseconds:
    """Return times of a scale other than UTC, nanoseconds since its 1970-01-01, in UTC; `NO_TIME` stays."""
    import erfa

    is_given = t_ns != NO_TIME
    own_ns = t_ns[is_given]
    table = erfa.leap_seconds.get()
    begins = np.array([int(np.datetime64(date(row["year"], row["month"], 1), "ns").astype(np.int64)) for row in table])
    tai_minus_utc_s = np.asarray(table["tai_utc"], np.float64)
    # A step takes effect at a UTC instant; on the other scale that instant is late by the new difference.
    own_minus_utc_ns = (tai_minus_utc_s * _NS).astype(np.int64) + _MINUS_TAI_NS[scale]
    step = np.searchsorted(begins + own_minus_utc_ns, own_ns, side="right") - 1
    utc_ns = t_ns.copy()
    utc_ns[is_given] = own_ns - own_minus_utc_ns[np.maximum(step, 0)]
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

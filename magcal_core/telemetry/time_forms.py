"""Declared forms of time: counts since an epoch, days, GPS weeks, days of the year, two columns, patterns.

What is not ISO 8601 with a zone, nor seconds since 1970, is read only where its form is declared: by `TimeForm`, or by
the column map, whose keys name the parts (`PARTS`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from magcal_core.errors import InputError, OptionError
from magcal_core.telemetry.iso_times import Spans, parse_iso_ns

_S: Final = 1_000_000_000
_DAY: Final = 86_400 * _S


def _zero(text: str) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


@dataclass(frozen=True, slots=True)
class Count:
    """Numbers that count from an epoch.

    Attributes
    ----------
    words : what people call it.
    unit_ns : nanoseconds in one.
    zero_ns : the epoch, nanoseconds since 1970-01-01 on the scale ``scale``.
    scale : ``utc``, or ``gps`` for a scale without leap seconds.
    """

    words: str
    unit_ns: int
    zero_ns: int
    scale: str = "utc"


COUNTS: Final[Mapping[str, Count]] = {
    "unix-s": Count("seconds since 1970", _S, 0),
    "unix-ms": Count("milliseconds since 1970", 1_000_000, 0),
    "unix-us": Count("microseconds since 1970", 1_000, 0),
    "unix-ns": Count("nanoseconds since 1970", 1, 0),
    "unix-days": Count("days since 1970", _DAY, 0),
    "gps": Count("GPS seconds", _S, _zero("1980-01-06"), "gps"),
    "j2000": Count("J2000 seconds", _S, _zero("2000-01-01T12:00")),
    "j2000-tt": Count("J2000 seconds of TT", _S, _zero("2000-01-01T12:00") - 51_184_000_000, "gps"),
    "jd": Count("Julian days", _DAY, -2_440_587 * _DAY - _DAY // 2),
    "mjd": Count("modified Julian days", _DAY, -40_587 * _DAY),
    "excel": Count("Excel days", _DAY, _zero("1899-12-30")),
}
"""Forms of one number. ``j2000`` is as flight software mostly keeps it: UTC, leap seconds not counted."""

UTC: Final = "utc"
"""ISO 8601, where a time without a zone is UTC."""
BOOT: Final = "boot"
"""Seconds since boot: an epoch is needed."""
DAY_OF_YEAR: Final = "doy"
"""``2022-050T22:37:44``, ``2022:050:22:37:44``, ``2022050.943``, ``22050.943``, or the day alone with a year."""
GPS_WEEK: Final = "gps-week"
DATE_TIME: Final = "date-time"
WORDS: Final[Mapping[str, str]] = {
    **{name: count.words for name, count in COUNTS.items()},
    UTC: "ISO 8601, UTC where there is no zone",
    BOOT: "seconds since boot (with an epoch)",
    DAY_OF_YEAR: "day of the year",
    GPS_WEEK: "GPS week and seconds of the week",
    DATE_TIME: "date and time in two columns",
}
"""Every declared form and what it is."""
PARTS: Final[Mapping[str, tuple[str, ...]]] = {
    GPS_WEEK: ("gps_week", "gps_seconds"),
    DATE_TIME: ("date", "time"),
    DAY_OF_YEAR: ("year", "day_of_year"),
}
"""Forms in several columns, and what the column map calls these."""
_ALIASES: Final[Mapping[str, str]] = {
    "unix": "unix-s", "s": "unix-s", "ms": "unix-ms", "us": "unix-us", "ns": "unix-ns", "epoch-ms": "unix-ms",
    "milliseconds": "unix-ms", "microseconds": "unix-us", "nanoseconds": "unix-ns", "gps-s": "gps",
    "gps-seconds": "gps", "gps-week-seconds": GPS_WEEK, "j2000-s": "j2000", "j2000-seconds": "j2000",
    "julian": "jd", "julian-days": "jd", "modified-julian-days": "mjd", "day-of-year": DAY_OF_YEAR,
    "excel-days": "excel", "date,time": DATE_TIME, "seconds-since-boot": BOOT, "iso-utc": UTC, "naive-utc": UTC,
}  # fmt: skip
MOST_OF_A_PATTERN: Final = 100
_NO_EPOCH: Final = "seconds since boot need the instant that they count from: --time-epoch 2022-02-19T22:00:00Z"


@dataclass(frozen=True, slots=True)
class TimeForm:
    """How the times of a table are written.

    Attributes
    ----------
    name : str
        A form of `WORDS`, a pattern of ``strptime``, or "": ISO 8601 with a zone or seconds since 1970.
    epoch_ns : int, optional
        The instant that ``boot`` counts from, or whose year ``doy`` is in, nanoseconds since 1970, UTC.
    spans : pairs of instants
        Where the orbits are good: by them a message tells the form that a time may have.
    """

    name: str = ""
    epoch_ns: int | None = None
    spans: Spans = ()

    @classmethod
    def of(cls, name: str | None, epoch: str | None = None, spans: Spans = ()) -> TimeForm:
        """Return the form called ``name``, checked.

        Raises
        ------
        OptionError
            There is no such form, its epoch is missing or none, or the pattern has no date.
        """
        plain = _named(name)
        epoch_ns = None if epoch is None else _epoch_ns(epoch)
        if plain == BOOT and epoch_ns is None:
            raise OptionError(_NO_EPOCH)
        if epoch_ns is not None and plain not in (BOOT, DAY_OF_YEAR):
            raise OptionError("a time epoch belongs to the time formats boot and doy")
        return cls(plain, epoch_ns, spans)

    @property
    def is_pattern(self) -> bool:
        """Whether the form is a pattern of ``strptime``."""
        return "%" in self.name

    @property
    def count(self) -> Count | None:
        """What a form of one number counts, None for the others."""
        if self.name == BOOT:
            return Count("seconds since boot", _S, self.epoch_ns or 0)
        return COUNTS.get(self.name)


ISO: Final = TimeForm()
"""ISO 8601 with a zone, or seconds since 1970: what needs no declaration."""


def _named(name: str | None) -> str:
    text = (name or "").strip()
    if "%" in text:
        if len(text) > MOST_OF_A_PATTERN or not any(mark in text for mark in ("%d", "%j", "%x", "%c", "%D", "%F")):
            raise OptionError("a pattern of times needs a day, such as %d.%m.%Y %H:%M:%S")
        return text
    plain = text.lower().replace("_", "-")
    plain = _ALIASES.get(plain, plain)
    if plain in ("", "iso"):
        return ""
    if plain not in WORDS:
        known = ", ".join(WORDS)
        raise OptionError(
            f"unknown time format {text[:40]!r}; known are {known}, or a pattern such as %d.%m.%Y %H:%M:%S"
        )
    return plain


def _epoch_ns(text: str) -> int:
    try:
        return parse_iso_ns(text)
    except InputError as error:
        raise OptionError(f"time epoch {text[:40]!r}: {error.message}") from error


@dataclass(frozen=True, slots=True)
class TimeColumns:
    """The columns that the times of one table stand in.

    Attributes
    ----------
    form : how they are written.
    own : part -> the table's own name; ``time`` alone where one column has it all.
    """

    form: TimeForm
    own: Mapping[str, str]

    @property
    def is_declared(self) -> bool:
        """Whether the times need more than the plain reading."""
        return bool(self.form.name)

    @property
    def words(self) -> str:
        """What people call the form."""
        return WORDS.get(self.form.name, f"of the pattern {self.form.name}")


def time_columns(form: TimeForm, mapped: Mapping[str, str]) -> TimeColumns:
    """Return where the times stand, by the column map and the form, and the form that both declare together.

    Raises
    ------
    OptionError
        The map declares another form than ``form``.
    """
    found = _form_of_map(mapped)
    name = found if found and not (form.is_pattern and found == DATE_TIME) else form.name
    if found and form.name not in ("", found, UTC) and not (form.is_pattern and found == DATE_TIME):
        raise OptionError(f"the column map has the times as {WORDS[found]}, the time format is {form.name}")
    if name == BOOT and form.epoch_ns is None:
        raise OptionError(_NO_EPOCH)
    key = _count_key(name)
    if found and key in mapped:
        return TimeColumns(replace(form, name=name), {"time": mapped[key]})
    parts = PARTS.get(name, ()) if found or name in (GPS_WEEK, DATE_TIME) else ()
    if not parts:
        is_dated = form.is_pattern and "date" in mapped
        parts = ("date", "time") if is_dated else ("time",)
    own = {part: mapped.get(part, part) for part in parts}
    if found == DAY_OF_YEAR and "time" in mapped:
        own["time"] = mapped["time"]
    return TimeColumns(replace(form, name=name), own)


def _count_key(name: str) -> str:
    return f"time_{name.replace('-', '_')}"


def _form_of_map(mapped: Mapping[str, str]) -> str:
    """Return the form that the keys of a column map declare, "" where they declare none."""
    for name, parts in PARTS.items():
        if parts[0] in mapped and (parts[1] in mapped or name == DATE_TIME):
            return name
    return next((name for name in (*COUNTS, BOOT, UTC, DAY_OF_YEAR) if _count_key(name) in mapped), "")


def is_time_key(key: str) -> bool:
    """Return whether a key of the column map names a part of the time."""
    parts = {part for names in PARTS.values() for part in names}
    return key in parts or key in {_count_key(name) for name in (*COUNTS, BOOT, UTC, DAY_OF_YEAR)}

"""Which declared form would make sense of times that cannot be read, or that are far from the orbit."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from datetime import UTC as UTC_ZONE
from datetime import datetime
from typing import Final

import numpy as np

from magcal_core.errors import InputError, TimeZoneMissingError
from magcal_core.telemetry.day_of_year import day_of_year_ns
from magcal_core.telemetry.iso_times import EARLIEST_NS, LATEST_NS, Spans, is_number, parse_iso_ns
from magcal_core.telemetry.time_forms import BOOT, COUNTS, DAY_OF_YEAR, UTC, WORDS

NEAR_DAYS: Final = 3.0
"""A form is named where it puts the times this near to the orbit, days."""
_NEAR_NS: Final = int(NEAR_DAYS * 86_400e9)
_USUAL: Final = tuple(int(np.datetime64(day, "ns").astype(np.int64)) for day in ("1990-01-01", "2060-01-01"))
"""Without an orbit, forms that give these years are named first."""
_LARGEST_BOOT_S: Final = 1e8
_OF_SECONDS: Final = ("gps", "j2000")
"""Forms whose small numbers are more likely seconds since boot."""
_CLOCKS: Final = ("%H:%M:%S", "%H:%M:%S.%f", "%H:%M", "%I:%M:%S %p", "%I:%M %p")
_DATES: Final = ("%d.%m.%Y", "%Y/%m/%d", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y", "%d-%b-%Y", "%d %b %Y", "%b %d %Y",
                 "%b %d, %Y", "%Y-%b-%d", "%Y.%m.%d", "%d/%b/%Y")  # fmt: skip
PATTERNS: Final = tuple(f"{day} {clock}" for day in _DATES for clock in _CLOCKS)
"""Forms of text that are tried; `strptime` reads them."""


def names_of_number(value: float, spans: Spans) -> list[str]:
    """Return the forms in which a number is a time within three days of ``spans``, or of the usual years without."""
    instants = {
        name: count.zero_ns + value * count.unit_ns
        for name, count in COUNTS.items()
        if name not in ("unix-s", "j2000-tt")
    }
    if 1e4 <= value < 1e7:
        with contextlib.suppress(InputError):
            instants[DAY_OF_YEAR] = float(day_of_year_ns(repr(value).removesuffix(".0"), None))
    plausible = {name: t_ns for name, t_ns in instants.items() if EARLIEST_NS <= t_ns < LATEST_NS}
    if spans:
        return [name for name, t_ns in plausible.items() if _is_near(t_ns, spans)]
    likely = {name: t_ns for name, t_ns in plausible.items() if name not in _OF_SECONDS or value > _LARGEST_BOOT_S}
    usual = [name for name, t_ns in likely.items() if _USUAL[0] <= t_ns < _USUAL[1]]
    return usual or list(likely)


def _is_near(t_ns: float, spans: Spans) -> bool:
    ends = [(_ns(begin), _ns(end)) for begin, end in spans]
    return any(begin - _NEAR_NS <= t_ns <= end + _NEAR_NS for begin, end in ends)


def _ns(instant: np.datetime64) -> int:
    return int(instant.astype("datetime64[ns]").astype(np.int64))


def forms_of(cell: str, spans: Spans = ()) -> list[str]:
    """Return the declared forms in which the text of one cell is a time, the likeliest first.

    Empty where it needs no declaration, and where no known form makes sense of it. ``spans`` are where orbits are good.
    """
    plain = cell.strip()
    if is_number(plain):
        value = float(plain)
        is_epoch = _is_near(value * 1e9, spans) if spans else _USUAL[0] <= value * 1e9 < _USUAL[1]
        names = [] if is_epoch else names_of_number(value, spans)
        return [BOOT] if not names and not is_epoch and 0.0 <= value < _LARGEST_BOOT_S else names
    try:
        parse_iso_ns(plain)
    except TimeZoneMissingError:
        return [UTC]
    except InputError:
        return _forms_of_text(plain, spans)
    return []


def _forms_of_text(text: str, spans: Spans) -> list[str]:
    found: dict[str, int | None] = {}
    with contextlib.suppress(InputError):
        found[DAY_OF_YEAR] = day_of_year_ns(text, None)
    found |= {pattern: _parsed(text, pattern) for pattern in PATTERNS}
    return [name for name, t_ns in found.items() if t_ns is not None and (not spans or _is_near(t_ns, spans))]


def on_number(value: float, spans: Spans) -> str:
    """Return what to declare of times such as ``value``, "" where nothing makes sense of them."""
    names = names_of_number(value, spans)
    if names:
        near = " (within three days of the orbit)" if spans else ""
        return _asked(names) + near
    if 0.0 <= value < _LARGEST_BOOT_S:
        return f"{WORDS[BOOT]}? --time-format {BOOT} --time-epoch 2022-02-19T22:00:00Z"
    return "no form that is known puts them within three days of the orbit" if spans else ""


def _asked(names: Sequence[str]) -> str:
    return " or ".join(f"{WORDS[name]}? --time-format {name}" for name in names)


def on_text(text: str, spans: Spans) -> str:
    """Return what to declare of times such as ``text``, "" where nothing makes sense of them."""
    plain = text.strip()
    if any(_parsed(plain, clock) is not None for clock in _CLOCKS):
        return 'a time of day alone: name the column of the date too, with the column map {"date": .., "time": ..}'
    near = _forms_of_text(plain, spans)
    if DAY_OF_YEAR in near:
        return _asked([DAY_OF_YEAR])
    return f"declare the form: {' or '.join(_option(pattern) for pattern in near)}" if near else ""


def _option(pattern: str) -> str:
    return f'--time-format "{pattern}"'


def _parsed(text: str, pattern: str) -> int | None:
    try:
        moment = datetime.strptime(text, pattern).replace(tzinfo=UTC_ZONE)
    except ValueError:
        return None
    return round((moment - datetime(1970, 1, 1, tzinfo=UTC_ZONE)).total_seconds()) * 1_000_000_000


def on_distance(t_utc: np.datetime64, spans: Spans) -> str:
    """Return what seconds that were read as seconds since 1970 may be, where ``t_utc`` is far from the orbit."""
    names = names_of_number(_ns(t_utc) / 1e9, spans) if spans else []
    return f": {_asked(names)}" if names else ""


def spans_of(epochs: Sequence[tuple[np.datetime64, np.datetime64 | None]]) -> Spans:
    """Return the spans of orbits: those of their epochs, or of their ephemerides."""
    return tuple((begin, begin if end is None else end) for begin, end in epochs)

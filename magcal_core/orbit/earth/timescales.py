"""UTC instants as Julian dates in the time scales of astronomy; `datetime64[ns]` is UTC everywhere in the core."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import erfa
import numpy as np

from magcal_core.arrays import Floats, Nanoseconds, Times
from magcal_core.errors import TimeError

UNIX_EPOCH_JD: Final = 2440587.5
UNIX_EPOCH_MJD: Final = 40587
TT_MINUS_TAI_S: Final = 32.184
NS_PER_DAY: Final = 86_400_000_000_000


def nanoseconds(t_utc: Times) -> Nanoseconds:
    """Return ``t_utc``, any `datetime64` unit, as nanoseconds since 1970-01-01 without leap seconds, shape (n,).

    Raises
    ------
    TimeError
        A time is NaT, or the array does not hold times.
    """
    times = np.atleast_1d(np.asarray(t_utc))
    if times.dtype.kind != "M":
        raise TimeError(f"times have type {times.dtype}; want datetime64 in UTC")
    if times.ndim != 1:
        raise TimeError(f"times have shape {times.shape}; want (n,)")
    stamps = np.ascontiguousarray(times.astype("datetime64[ns]", copy=False)).view(np.int64)
    if stamps.size and stamps.min() == np.iinfo(np.int64).min:
        raise TimeError(f"time {int(stamps.argmin())} is not a time (NaT)")
    return stamps


@lru_cache(maxsize=1)
def _leap_seconds() -> tuple[Nanoseconds, Floats]:
    """Return the starts of validity, nanoseconds since 1970, and TAI - UTC, s, from 1972 on."""
    table = erfa.leap_seconds.get()
    table = table[table["year"] >= 1972]
    starts = [np.datetime64(f"{row['year']:04d}-{row['month']:02d}-01", "ns").astype(np.int64) for row in table]
    return np.array(starts, np.int64), np.array(table["tai_utc"], np.float64)


def tai_minus_utc_s(t_utc: Times) -> Floats:
    """Return TAI - UTC at ``t_utc``, shape (n,), s.

    Raises
    ------
    TimeError
        A time is before 1972, when UTC did not yet step by whole seconds.
    """
    starts, offsets_s = _leap_seconds()
    stamps = nanoseconds(t_utc)
    step = np.searchsorted(starts, stamps, side="right") - 1
    if stamps.size and step.min() < 0:
        raise TimeError(f"time {stamps.min().astype('datetime64[ns]')} is before 1972-01-01, the start of today's UTC")
    return offsets_s[step]


def julian_utc(t_utc: Times) -> tuple[Floats, Floats]:
    """Return the Julian date of ``t_utc`` in UTC as whole day and fraction, each of shape (n,)."""
    days, of_day = np.divmod(nanoseconds(t_utc), NS_PER_DAY)
    return UNIX_EPOCH_JD + days, of_day / NS_PER_DAY


def julian_tt(t_utc: Times) -> tuple[Floats, Floats]:
    """Return the Julian date of ``t_utc`` in terrestrial time (TT) as whole day and fraction, each of shape (n,)."""
    day, fraction = julian_utc(t_utc)
    return day, fraction + (tai_minus_utc_s(t_utc) + TT_MINUS_TAI_S) / 86400.0

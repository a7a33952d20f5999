"""TEME and GCRF to ITRF and back for many samples: the rotations of `magcal_core.orbit.earth.frames`, in one pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import erfa
import numpy as np

from magcal_core.arrays import Floats, Nanoseconds, Times
from magcal_core.numerics.interpolation import lagrange_powers
from magcal_core.numerics.kernel import kernel
from magcal_core.orbit.earth.eop import earth_orientation
from magcal_core.orbit.earth.timescales import NS_PER_DAY, TT_MINUS_TAI_S, julian_tt, nanoseconds, tai_minus_utc_s

Pair = tuple[float, float]

_J2000_NS: Final = 946_728_000_000_000_000
_HALF_PI: Final = math.pi / 2.0
_CIP_NODES: Final = 7


@kernel(inline="always", error_model="numpy", fastmath={"contract", "nsz"})
def _sine_and_cosine(quarters: float) -> tuple[float, float]:
    """Return sine and cosine of an angle in quarter turns, by their series within an eighth of a turn (1e-16)."""
    nearest = math.floor(quarters + 0.5)
    x = (quarters - nearest) * _HALF_PI
    q = x * x
    sine = x * (1 + q * (-1 / 6 + q * (1 / 120 + q * (-1 / 5040 + q * (1 / 362880 + q * (
        -1 / 39916800 + q * (1 / 6227020800 - q / 1307674368000)))))))  # fmt: skip
    cosine = 1 + q * (-0.5 + q * (1 / 24 + q * (-1 / 720 + q * (1 / 40320 + q * (-1 / 3628800 + q * (
        1 / 479001600 + q * (-1 / 87178291200 + q / 20922789888000)))))))  # fmt: skip
    turn = nearest - 4.0 * math.floor(nearest * 0.25)
    is_odd = turn == 1.0 or turn == 3.0  # noqa: PLR1714 (numba)
    s, c = (cosine, sine) if is_odd else (sine, cosine)
    s = -s if turn >= 2.0 else s
    c = -c if turn == 1.0 or turn == 2.0 else c  # noqa: PLR1714 (numba)
    return s, c


@kernel(inline="always", error_model="numpy", fastmath={"contract", "nsz"})
def _sextic(c: Floats, v: float) -> float:
    value: float = c[0] + v * (c[1] + v * (c[2] + v * (c[3] + v * (c[4] + v * (c[5] + v * c[6])))))
    return value


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _rotate_teme_run(  # noqa: PLR0917 (numba takes no keyword arguments)
    since_midnight_ns: Nanoseconds,
    midnight_ns: int,
    ut1_utc_s: Pair,
    pole_x_rad: Pair,
    pole_y_rad: Pair,
    r_teme_km: Floats,
    r_itrf_km: Floats,
) -> None:
    """Rotate the samples of one day; the pairs are the values at 0 h and their change over the day.

    Notes
    -----
    GMST82 as `erfa.gmst82`; W = R1(-yp) R2(-xp) as `erfa.pom00`, its sines and cosines to the third order (1e-24 of
    2e-6 rad).
    """
    days = (midnight_ns - _J2000_NS) / NS_PER_DAY
    for i in range(len(since_midnight_ns)):
        part = since_midnight_ns[i] / NS_PER_DAY
        ut1_s = part * 86400.0 + ut1_utc_s[0] + part * ut1_utc_s[1]
        century = (days + ut1_s / 86400.0) / 36525.0
        gmst_s = (24110.54841 + (8640184.812866 + (0.093104 - 6.2e-6 * century) * century) * century) + ut1_s
        s, c = _sine_and_cosine(gmst_s / 21600.0)
        a = c * r_teme_km[i, 0] + s * r_teme_km[i, 1]
        b = c * r_teme_km[i, 1] - s * r_teme_km[i, 0]
        z = r_teme_km[i, 2]
        xp, yp = pole_x_rad[0] + part * pole_x_rad[1], pole_y_rad[0] + part * pole_y_rad[1]
        sx, cx = xp - xp * xp * xp / 6.0, 1.0 - 0.5 * xp * xp
        sy, cy = yp - yp * yp * yp / 6.0, 1.0 - 0.5 * yp * yp
        along = cx * z - sx * a
        r_itrf_km[i, 0] = cx * a + sx * z
        r_itrf_km[i, 1] = cy * b - sy * along
        r_itrf_km[i, 2] = sy * b + cy * along


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _rotate_to_gcrf_run(  # noqa: PLR0917 (numba takes no keyword arguments)
    since_midnight_ns: Nanoseconds,
    midnight_ns: int,
    ut1_utc_s: Pair,
    pole_x_rad: Pair,
    pole_y_rad: Pair,
    tt_utc_s: float,
    tio_rad: float,
    cip: Floats,
    of_itrf: Floats,
    of_gcrf: Floats,
) -> None:
    """Rotate the vectors of one day to GCRF; ``cip``, (3, k), has X, Y, s as polynomials in quarter days from 12 h TT.

    Notes
    -----
    The transpose of W R3(ERA - s + s') Q(X, Y) (IERS2010, 5.4.1 and 5.10).
    """
    days = (midnight_ns - _J2000_NS) / NS_PER_DAY
    of_x, of_y, of_s = cip[0], cip[1], cip[2]
    for i in range(len(since_midnight_ns)):
        part = since_midnight_ns[i] / NS_PER_DAY
        v = (part * 86400.0 + tt_utc_s) / 21600.0 - 2.0
        x, y, locator = _sextic(of_x, v), _sextic(of_y, v), _sextic(of_s, v)
        xp, yp = pole_x_rad[0] + part * pole_x_rad[1], pole_y_rad[0] + part * pole_y_rad[1]
        sx, cx = xp - xp * xp * xp / 6.0, 1.0 - 0.5 * xp * xp
        sy, cy = yp - yp * yp * yp / 6.0, 1.0 - 0.5 * yp * yp
        along = cy * of_itrf[i, 2] - sy * of_itrf[i, 1]
        a = cx * of_itrf[i, 0] - sx * along
        b = cy * of_itrf[i, 1] + sy * of_itrf[i, 2]
        c = sx * of_itrf[i, 0] + cx * along
        ut1_days = part + (ut1_utc_s[0] + part * ut1_utc_s[1]) / 86400.0
        turns = ut1_days + 0.5 + 0.7790572732640 + 0.00273781191135448 * (days + ut1_days)
        sine, cosine = _sine_and_cosine(4.0 * turns + (tio_rad - locator) / _HALF_PI)
        p, q = cosine * a - sine * b, sine * a + cosine * b
        scale = 1.0 / (1.0 + math.sqrt(1.0 - x * x - y * y))
        common = c - scale * (x * p + y * q)
        of_gcrf[i, 0] = p + x * common
        of_gcrf[i, 1] = q + y * common
        of_gcrf[i, 2] = c - x * p - y * q - scale * (x * x + y * y) * c


@dataclass(frozen=True, slots=True)
class _Day:
    """Samples that follow each other within one day, and the Earth's orientation over it."""

    rows: slice
    midnight_ns: int
    tai_utc_s: float
    ut1_utc_s: Pair
    pole_x_rad: Pair
    pole_y_rad: Pair


def _days(t_utc: Times, stamps: Nanoseconds) -> list[_Day]:
    table = earth_orientation()
    table.check(t_utc)
    if not len(stamps):
        return []
    day = (stamps - table.start_ns) // NS_PER_DAY
    edges = [0, *(np.flatnonzero(day[1:] != day[:-1]) + 1).tolist(), len(stamps)]
    firsts = np.minimum(day[edges[:-1]], len(table.ut1_tai_s) - 2)
    offsets_s = tai_minus_utc_s((table.start_ns + day[edges[:-1]] * NS_PER_DAY).view("datetime64[ns]"))
    days = []
    for run, (first, offset_s) in enumerate(zip(firsts.tolist(), offsets_s.tolist(), strict=True)):
        ut1, pole_x, pole_y = (
            (float(column[first]), float(column[first + 1] - column[first]))
            for column in (table.ut1_tai_s, table.xp_rad, table.yp_rad)
        )
        rows = slice(edges[run], edges[run + 1])
        midnight_ns = table.start_ns + first * NS_PER_DAY
        days.append(_Day(rows, midnight_ns, offset_s, (ut1[0] + offset_s, ut1[1]), pole_x, pole_y))
    return days


def _cip_polynomials(days: Sequence[_Day]) -> Floats:
    """Return X, Y and s of IAU 2006/2000A about 12 h TT of each day, shape (days, 3, k), in quarter days.

    Notes
    -----
    Through seven nodes a quarter of a day apart: within 1e-12 rad of the series.
    """
    noon = np.array([2 * (2 * (day.midnight_ns - _J2000_NS) // NS_PER_DAY + 1) for day in days])
    ids = noon[:, None] + np.arange(_CIP_NODES) - _CIP_NODES // 2
    nodes, place = np.unique(ids, return_inverse=True)
    series = np.array([_cip_at(quarter) for quarter in nodes.tolist()]).T
    return np.ascontiguousarray(np.einsum("kj,cdj->dck", lagrange_powers(_CIP_NODES), series[:, place]))


@lru_cache(maxsize=4096)
def _cip_at(quarter_days: int) -> tuple[float, float, float]:
    """Return X, Y and s of IAU 2006/2000A, rad, so many quarter days of TT after J2000: a thousand terms each."""
    x, y, locator = erfa.xys06a(erfa.DJ00, quarter_days / 4.0)
    return float(x), float(y), float(locator)


def teme_to_itrf_fast(t_utc: Times, r_teme_km: Floats) -> Floats:
    """Return positions in ITRF, shape (n, 3), km, from TEME, shape (n, 3), km, at ``t_utc``, shape (n,).

    Raises
    ------
    ModelRangeError
        A time is outside the table of Earth orientation.
    """
    stamps = nanoseconds(t_utc)
    r_itrf_km = np.empty((len(stamps), 3))
    for day in _days(t_utc, stamps):
        rows = day.rows
        pairs = (day.ut1_utc_s, day.pole_x_rad, day.pole_y_rad)
        since_ns = stamps[rows] - day.midnight_ns
        _rotate_teme_run(since_ns, day.midnight_ns, *pairs, r_teme_km[rows], r_itrf_km[rows])
    return r_itrf_km


def itrf_to_gcrf_fast(t_utc: Times, of_itrf: Floats) -> Floats:
    """Return vectors in GCRF, shape (n, 3), from ITRF, shape (n, 3), at ``t_utc``, shape (n,), in their unit.

    Raises
    ------
    ModelRangeError
        A time is outside the table of Earth orientation.
    """
    stamps = nanoseconds(t_utc)
    of_gcrf = np.empty((len(stamps), 3))
    days = _days(t_utc, stamps)
    for day, cip in zip(days, _cip_polynomials(days) if days else (), strict=True):
        rows = day.rows
        tt_utc_s = day.tai_utc_s + TT_MINUS_TAI_S
        tio_rad = float(erfa.sp00(*julian_tt(t_utc[rows][:1]))[0])
        pairs = (day.ut1_utc_s, day.pole_x_rad, day.pole_y_rad)
        since_ns = stamps[rows] - day.midnight_ns
        _rotate_to_gcrf_run(since_ns, day.midnight_ns, *pairs, tt_utc_s, tio_rad, cip, of_itrf[rows], of_gcrf[rows])
    return of_gcrf

"""TEME to ITRF for many samples: the same rotation as `magcal_core.orbit.frames`, in one pass."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from magcal_core.orbit.eop import earth_orientation
from magcal_core.orbit.timescales import NS_PER_DAY, Times, nanoseconds, tai_minus_utc_s

Floats = NDArray[np.float64]
Nanoseconds = NDArray[np.int64]

_J2000_NS: Final = 946_728_000_000_000_000
_HALF_PI: Final = math.pi / 2.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _rotate_run(  # noqa: PLR0917 (numba takes no keyword arguments)
    since_midnight_ns: Nanoseconds,
    midnight_ns: int,
    ut1_utc_s: tuple[float, float],
    pole_x_rad: tuple[float, float],
    pole_y_rad: tuple[float, float],
    r_teme_km: Floats,
    r_itrf_km: Floats,
) -> None:
    """Rotate the samples of one day; the pairs are the values at 0 h and their change over the day.

    Notes
    -----
    GMST82 as `erfa.gmst82`; sine and cosine by their series within an eighth of a turn, so that the loop runs on
    vectors (1e-16); W = R1(-yp) R2(-xp) as `erfa.pom00`, its sines and cosines to the third order (1e-24 of 2e-6 rad).
    """
    days = (midnight_ns - _J2000_NS) / NS_PER_DAY
    for i in range(len(since_midnight_ns)):
        part = since_midnight_ns[i] / NS_PER_DAY
        ut1_s = part * 86400.0 + ut1_utc_s[0] + part * ut1_utc_s[1]
        century = (days + ut1_s / 86400.0) / 36525.0
        gmst_s = (24110.54841 + (8640184.812866 + (0.093104 - 6.2e-6 * century) * century) * century) + ut1_s
        quarters = gmst_s / 21600.0
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


def teme_to_itrf_fast(t_utc: Times, r_teme_km: Floats) -> Floats:
    """Return positions in ITRF, shape (n, 3), km, from TEME, shape (n, 3), km, at ``t_utc``, shape (n,).

    Raises
    ------
    ModelRangeError
        A time is outside the table of Earth orientation.
    """
    stamps = nanoseconds(t_utc)
    table = earth_orientation()
    table.check(t_utc)
    r_itrf_km = np.empty((len(stamps), 3))
    if not len(stamps):
        return r_itrf_km
    day = (stamps - table.start_ns) // NS_PER_DAY
    edges = [0, *(np.flatnonzero(day[1:] != day[:-1]) + 1).tolist(), len(stamps)]
    firsts = np.minimum(day[edges[:-1]], len(table.ut1_tai_s) - 2)
    midnights = table.start_ns + firsts * NS_PER_DAY
    offsets_s = tai_minus_utc_s((table.start_ns + day[edges[:-1]] * NS_PER_DAY).view("datetime64[ns]"))
    for run, (first, midnight) in enumerate(zip(firsts.tolist(), midnights.tolist(), strict=True)):
        rows = slice(edges[run], edges[run + 1])
        pairs = [
            (float(column[first]), float(column[first + 1] - column[first]))
            for column in (table.ut1_tai_s, table.xp_rad, table.yp_rad)
        ]
        ut1_utc_s = (pairs[0][0] + float(offsets_s[run]), pairs[0][1])
        _rotate_run(stamps[rows] - midnight, midnight, ut1_utc_s, pairs[1], pairs[2], r_teme_km[rows], r_itrf_km[rows])
    return r_itrf_km

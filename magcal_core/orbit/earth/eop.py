"""How the Earth really rotates: UT1 and polar motion from the IERS table that comes with `astropy-iers-data`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import astropy_iers_data
import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.errors import ModelRangeError
from magcal_core.orbit.earth.timescales import NS_PER_DAY, UNIX_EPOCH_MJD, julian_utc, nanoseconds, tai_minus_utc_s

_MJD: Final = slice(7, 15)
_FLAG: Final = 57
_XP_ARCSEC: Final = (slice(134, 144), slice(18, 27))
_YP_ARCSEC: Final = (slice(144, 154), slice(37, 46))
_UT1_UTC_S: Final = (slice(154, 165), slice(58, 68))
UT1_ERROR_S: Final = 0.00025
UT1_ERROR_POWER: Final = 0.75
"""Error of predicted UT1, s = 0.00025 days^0.75, as every Bulletin A states it [IERSA]_."""
_RAD_PER_ARCSEC: Final = np.pi / 648000.0


@dataclass(frozen=True, slots=True, eq=False)
class EarthOrientation:
    """Daily values at 0 h UTC, interpolated linearly between.

    Attributes
    ----------
    start_ns : int
        First day of the table, nanoseconds since 1970.
    ut1_tai_s : shape (k,)
        UT1 - TAI, s: unlike UT1 - UTC it has no jump at a leap second.
    xp_rad, yp_rad : shape (k,)
        Coordinates of the pole, rad.
    predicted_from : datetime64
        First day that is a prediction.
    """

    start_ns: int
    ut1_tai_s: Floats
    xp_rad: Floats
    yp_rad: Floats
    predicted_from: np.datetime64

    @property
    def first(self) -> np.datetime64:
        """First instant of the table, UTC."""
        return np.datetime64(self.start_ns, "ns")

    @property
    def last(self) -> np.datetime64:
        """Last instant of the table, UTC; later than `predicted_from`."""
        return np.datetime64(self.start_ns + (len(self.ut1_tai_s) - 1) * NS_PER_DAY, "ns")

    def predicted_days(self, t_utc: Times) -> float:
        """Return how far, days, the latest of ``t_utc`` lies beyond the last measured value; 0 where none does."""
        stamps = nanoseconds(t_utc)
        last_ns = int(nanoseconds(np.array([self.predicted_from]))[0]) - NS_PER_DAY
        return max(0.0, (int(stamps.max()) - last_ns) / NS_PER_DAY) if stamps.size else 0.0

    def check(self, t_utc: Times) -> None:
        """Refuse times outside the table.

        Raises
        ------
        ModelRangeError
            A time is before 1973-01-02 or after the last prediction.
        """
        stamps = nanoseconds(t_utc)
        if not stamps.size:
            return
        for stamp in (stamps.min(), stamps.max()):
            time = np.datetime64(int(stamp), "ns")
            if not self.first <= time <= self.last:
                raise ModelRangeError(
                    f"Earth orientation at {np.datetime_as_string(time, unit='s')}Z is not known: the table has "
                    f"{np.datetime_as_string(self.first, unit='D')} to {np.datetime_as_string(self.last, unit='D')}; "
                    "a newer astropy-iers-data reaches further"
                )

    def _place(self, t_utc: Times) -> tuple[NDArray[np.intp], Floats]:
        self.check(t_utc)
        day, of_day = np.divmod(nanoseconds(t_utc) - self.start_ns, NS_PER_DAY)
        index = np.minimum(day, len(self.ut1_tai_s) - 2)
        return index, (day - index) + of_day / NS_PER_DAY

    def ut1_minus_utc_s(self, t_utc: Times) -> Floats:
        """Return UT1 - UTC at ``t_utc``, shape (n,), s, also across a leap second."""
        index, part = self._place(t_utc)
        step = np.diff(self.ut1_tai_s)
        return self.ut1_tai_s[index] + part * step[index] + tai_minus_utc_s(t_utc)

    def ut1_rate(self, t_utc: Times) -> Floats:
        """Return d(UT1)/d(TAI) at ``t_utc``, shape (n,): 1 less the relative excess of the length of day."""
        index, _ = self._place(t_utc)
        return 1.0 + np.diff(self.ut1_tai_s)[index] / 86400.0

    def polar_motion_rad(self, t_utc: Times) -> tuple[Floats, Floats]:
        """Return the pole's coordinates x and y at ``t_utc``, each of shape (n,), rad."""
        index, part = self._place(t_utc)
        x_rad = self.xp_rad[index] + part * np.diff(self.xp_rad)[index]
        return x_rad, self.yp_rad[index] + part * np.diff(self.yp_rad)[index]

    def julian_ut1(self, t_utc: Times) -> tuple[Floats, Floats]:
        """Return the Julian date of ``t_utc`` in UT1 as whole day and fraction, each of shape (n,)."""
        day, fraction = julian_utc(t_utc)
        return day, fraction + self.ut1_minus_utc_s(t_utc) / 86400.0


def ut1_prediction_error_s(days: float) -> float:
    """Return the standard error of UT1 predicted ``days`` ahead, s: 1.4 ms after 10 days [IERSA]_."""
    return float(UT1_ERROR_S * days**UT1_ERROR_POWER)


@lru_cache(maxsize=1)
def earth_orientation() -> EarthOrientation:
    """Return the table of `astropy-iers-data`, read once in a process.

    Notes
    -----
    ``finals2000A.all``: Bulletin B where it is given, else Bulletin A, final and then predicted (IERS2010). Diurnal
    and semidiurnal tides in UT1 and polar motion are left out: at most 3 cm at the Earth's surface.
    """
    content = Path(astropy_iers_data.IERS_A_FILE).read_bytes()
    lines = np.frombuffer(content, "S1").reshape(-1, content.index(b"\n") + 1)
    rows = lines[(lines[:, _UT1_UTC_S[1]] != b" ").any(axis=1) & (lines[:, _XP_ARCSEC[1]] != b" ").any(axis=1)]
    mjd = _numbers(rows[:, _MJD])
    if not np.all(np.diff(mjd) == 1.0):
        raise ModelRangeError("the IERS table of astropy-iers-data has a gap")
    start_ns = (int(mjd[0]) - UNIX_EPOCH_MJD) * NS_PER_DAY
    days = (start_ns + np.arange(len(rows)) * NS_PER_DAY).view("datetime64[ns]")
    predicted = np.flatnonzero(rows[:, _FLAG] == b"P")
    return EarthOrientation(
        start_ns=start_ns,
        ut1_tai_s=_column(rows, _UT1_UTC_S) - tai_minus_utc_s(days),
        xp_rad=_column(rows, _XP_ARCSEC) * _RAD_PER_ARCSEC,
        yp_rad=_column(rows, _YP_ARCSEC) * _RAD_PER_ARCSEC,
        predicted_from=days[predicted[0] if predicted.size else -1],
    )


def _column(rows: NDArray[np.bytes_], bulletins: tuple[slice, slice]) -> Floats:
    """Return a column as Bulletin B has it, where it has it, else as Bulletin A."""
    final, quick = (rows[:, columns] for columns in bulletins)
    is_final = (final != b" ").any(axis=1)
    values = np.empty(len(rows))
    values[is_final], values[~is_final] = _numbers(final[is_final]), _numbers(quick[~is_final])
    return values


def _numbers(characters: NDArray[np.bytes_]) -> Floats:
    """Return the numbers that the rows of single ``characters`` spell."""
    width = characters.shape[1]
    return np.ascontiguousarray(characters).view(f"S{width}")[:, 0].astype(np.float64)

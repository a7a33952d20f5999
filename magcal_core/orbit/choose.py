"""Which orbit gives the position at which time, and how old it is then."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Indices, Times
from magcal_core.errors import OrbitMissingError, TleEpochError
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.timescales import NS_PER_DAY, nanoseconds

FRESH_DAYS: Final = 3.0
"""Up to this age a TLE needs no warning, days."""
MAX_AGE_DAYS: Final = 14.0
"""Beyond this age a TLE is refused unless the caller allows more, days."""
NO_ORBIT: Final = -1


@runtime_checkable
class BoundedOrbit(Protocol):
    """An orbit that is known between some times and nowhere else, such as an ephemeris."""

    def covers(self, t_utc: Times) -> NDArray[np.bool_]:
        """Return at which times the position is known, shape (n,)."""
        ...


@runtime_checkable
class InterpolatedOrbit(Protocol):
    """An orbit that is known at some points, and interpolated between them."""

    def interpolation_error_km(self, t_utc: Times) -> NDArray[np.float64]:
        """Return how far interpolation is off at the most about each time, km, shape (n,)."""
        ...

    def is_astray(self, t_utc: Times) -> NDArray[np.bool_]:
        """Return whether the points about each time are not those of an orbit under known forces, shape (n,)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The orbit of every sample.

    Attributes
    ----------
    index : shape (n,)
        Position of the orbit in the sequence that it was chosen from; -1 where none is usable.
    age_days : shape (n,)
        Distance of the sample from the orbit's epoch, days; 0 inside an ephemeris, NaN without an orbit.
    """

    index: Indices
    age_days: Floats

    def rows(self, orbit: int) -> Indices:
        """Return the samples that use the orbit at this position."""
        return np.flatnonzero(self.index == orbit)

    def by_orbit(self) -> Iterator[tuple[int, Indices]]:
        """Yield each orbit that is used, by its position in the sequence, with the samples that use it in order."""
        order = np.argsort(self.index, kind="stable")
        orbits, starts = np.unique(self.index[order], return_index=True)
        for orbit, rows in zip(orbits.tolist(), np.split(order, starts[1:]), strict=True):
            if orbit != NO_ORBIT:
                yield orbit, rows


def choose_orbits(orbits: Sequence[Orbit], t_utc: Times) -> Choice:
    """Return, for every time, the ephemeris that covers it (the later one of two), else the orbit of the nearest epoch.

    Raises
    ------
    OrbitMissingError
        There is no orbit at all.
    """
    if not orbits:
        raise OrbitMissingError("there is no orbit, and the telemetry has neither reference field nor position")
    stamps = nanoseconds(t_utc)
    index = np.full(len(stamps), NO_ORBIT, np.intp)
    age_days = np.full(len(stamps), np.nan)
    free = [i for i, orbit in enumerate(orbits) if not isinstance(orbit, BoundedOrbit)]
    if free:
        epochs_ns = np.array([orbits[i].epoch_utc for i in free], "datetime64[ns]").astype(np.int64)
        by_epoch = np.argsort(epochs_ns, kind="stable")
        sorted_ns = epochs_ns[by_epoch]
        halfway_ns = sorted_ns[:-1] + np.diff(sorted_ns) // 2
        nearest = np.searchsorted(halfway_ns, stamps, side="left") if len(free) > 1 else 0
        index[:] = np.array(free, np.intp)[by_epoch[nearest]]
        age_days[:] = np.abs(stamps - sorted_ns[nearest]) / NS_PER_DAY
    for i, orbit in enumerate(orbits):
        if isinstance(orbit, BoundedOrbit):
            covered = orbit.covers(t_utc)
            index[covered], age_days[covered] = i, 0.0
    return Choice(index, age_days)


def check_age(choice: Choice, orbits: Sequence[Orbit], max_age_days: float = MAX_AGE_DAYS) -> list[str]:
    """Return the warnings about old orbits.

    Raises
    ------
    TleEpochError
        An orbit is farther from a sample than ``max_age_days``.
    """
    known = choice.index != NO_ORBIT
    if not known.any():
        return []
    worst = int(np.nanargmax(choice.age_days))
    age_days = float(choice.age_days[worst])
    orbit = orbits[int(choice.index[worst])]
    kind = "TLE" if orbit.model == "sgp4" else "state"
    epoch = np.datetime_as_string(orbit.epoch_utc, unit="s")
    if age_days > max_age_days:
        raise TleEpochError(
            f"the epoch of the {kind}, {epoch}Z, is {age_days:.1f} d from the telemetry; limit {max_age_days:.1f} d"
        )
    if age_days <= FRESH_DAYS:
        return []
    code = "tle_old" if orbit.model == "sgp4" else "orbit_old"
    return [f"{code}: the epoch of the {kind}, {epoch}Z, is {age_days:.1f} d from the telemetry"]

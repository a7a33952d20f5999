"""Units of magnetic flux density and their factors to nT, and UTC as text; inside all is nT, km, s, rad."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from magcal_core.errors import UnitsError, UnitsMissingError

if TYPE_CHECKING:
    import numpy as np

NT_PER_UNIT: Final[dict[str, float]] = {"nT": 1.0, "uT": 1e3, "mT": 1e6, "T": 1e9, "G": 1e5, "mG": 1e2}
"""nT in one of each unit that a magnetometer may report."""

TIME_SCALES: Final = ("utc", "gps", "tai", "tt")
"""Scales that the clock of telemetry may keep."""

COUNTS: Final = "counts"
"""Unit of a magnetometer that sends counts; how many nT one is has to be said beside it."""


def nt_per(unit: str | None, nt_per_count: float | None = None) -> float:
    """Return the nT in one ``unit``; of ``counts`` that is ``nt_per_count``.

    Raises
    ------
    UnitsMissingError
        No unit was given: there is no default; or counts without their size.
    UnitsError
        The unit is not one of `NT_PER_UNIT`, or has a size of a count that it cannot have.
    """
    if unit is None or not unit.strip():
        raise UnitsMissingError(f"the magnetometer's unit is missing; give one of {', '.join((*NT_PER_UNIT, COUNTS))}")
    if unit == COUNTS:
        if nt_per_count is None:
            raise UnitsMissingError("the unit is counts, and the nT in one are not said: --nt-per-count (nt_per_count)")
        if not 0.0 < nt_per_count < 1e9:
            raise UnitsError(f"{nt_per_count:g} nT per count; want more than 0")
        return nt_per_count
    if nt_per_count is not None:
        raise UnitsError(f"nT per count are given, and the unit is {unit[:20]!r}; they belong to the unit counts")
    if unit not in NT_PER_UNIT:
        raise UnitsError(f"unknown unit {unit!r}; known are {', '.join((*NT_PER_UNIT, COUNTS))}")
    return NT_PER_UNIT[unit]


def utc_text(t_utc: np.datetime64) -> str:
    """Return ``t_utc`` in ISO 8601 with ``Z`` and microseconds."""
    import numpy as np

    return f"{np.datetime_as_string(t_utc, unit='us')}Z"

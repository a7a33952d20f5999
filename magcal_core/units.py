"""Units of magnetic flux density and their factors to nT, and UTC as text; inside all is nT, km, s, rad."""

from typing import Final

import numpy as np

from magcal_core.errors import UnitsError, UnitsMissingError

NT_PER_UNIT: Final[dict[str, float]] = {"nT": 1.0, "uT": 1e3, "mT": 1e6, "T": 1e9, "G": 1e5, "mG": 1e2}
"""nT in one of each unit that a magnetometer may report."""


def nt_per(unit: str | None) -> float:
    """Return the nT in one ``unit``.

    Raises
    ------
    UnitsMissingError
        No unit was given: there is no default.
    UnitsError
        The unit is not one of `NT_PER_UNIT`.
    """
    if unit is None or not unit.strip():
        raise UnitsMissingError(f"the magnetometer's unit is missing; give one of {', '.join(NT_PER_UNIT)}")
    if unit not in NT_PER_UNIT:
        raise UnitsError(f"unknown unit {unit!r}; known are {', '.join(NT_PER_UNIT)}")
    return NT_PER_UNIT[unit]


def utc_text(t_utc: np.datetime64) -> str:
    """Return ``t_utc`` in ISO 8601 with ``Z`` and microseconds."""
    return f"{np.datetime_as_string(t_utc, unit='us')}Z"

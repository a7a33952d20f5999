"""An ephemeris of another form as the text of an OEM, in which it is kept and read again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.errors import OrbitFormatError
from magcal_core.numerics.interpolation import StateTable
from magcal_core.orbit.earth.timescales import nanoseconds

_SLOPE_DEGREE = 8
"""Of the polynomial whose slope is the velocity where a file has none."""


@dataclass(frozen=True, slots=True)
class Ephemeris:
    """Positions, km, and velocities, km/s (None where a file has none), shape (n, 3), at times UTC, in one frame."""

    name: str
    cospar_id: str
    frame: str
    t_utc: Times
    r_km: Floats
    v_km_s: Floats | None
    interpolation: str
    degree: int

    def text(self, source: str) -> str:
        """Return the ephemeris as an OEM; ``source`` says in a comment what it was.

        Raises
        ------
        OrbitFormatError
            There are too few positions.
        """
        if len(self.t_utc) < 2:
            raise OrbitFormatError(f"the {source} has {len(self.t_utc)} positions; want 2 at least")
        method, degree = self.interpolation, min(self.degree, len(self.t_utc) - 1)
        v_km_s = self._slopes() if self.v_km_s is None else self.v_km_s
        stamps = [np.datetime_as_string(t, unit="ns") for t in self.t_utc]
        head = {
            "OBJECT_NAME": self.name,
            "OBJECT_ID": self.cospar_id,
            "CENTER_NAME": "EARTH",
            "REF_FRAME": self.frame,
            "TIME_SYSTEM": "UTC",
            "START_TIME": stamps[0],
            "STOP_TIME": stamps[-1],
            "INTERPOLATION": method,
            "INTERPOLATION_DEGREE": str(degree),
        }
        has_own = "velocities as they were" if self.v_km_s is not None else "velocities are slopes of the positions"
        lines = ["CCSDS_OEM_VERS = 2.0", f"COMMENT from {source}; {has_own}", "META_START"]
        lines += [f"{key} = {value}" for key, value in head.items() if value]
        rows = zip(stamps, self.r_km.tolist(), v_km_s.tolist(), strict=True)
        states = (" ".join([stamp, *map(repr, [*r, *v])]) for stamp, r, v in rows)
        return "\n".join([*lines, "META_STOP", *states]) + "\n"

    def _slopes(self) -> Floats:
        """Return the slope of the polynomial through the nearest positions at each node, km/s, shape (n, 3)."""
        stamps = nanoseconds(self.t_utc)
        degree = min(_SLOPE_DEGREE, len(stamps) - 1)
        table = StateTable(stamps, self.r_km, np.zeros_like(self.r_km))
        step_ns = max(int(np.diff(stamps).min()) // 1000, 1)
        after, _ = table.lagrange(stamps + step_ns, degree)
        before, _ = table.lagrange(stamps - step_ns, degree)
        slopes: Floats = (after - before) / (2e-9 * step_ns)
        return slopes

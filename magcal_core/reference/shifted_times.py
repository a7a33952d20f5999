"""The reference at times that move, as the search for the clock's offset asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import rotate_rows
from magcal_core.errors import OrbitMissingError
from magcal_core.field import FieldModel
from magcal_core.numerics.vectors import lengths
from magcal_core.orbit import Orbit
from magcal_core.orbit.choose import NO_ORBIT, BoundedOrbit, choose_orbits
from magcal_core.reference.field_along_orbit import FieldAlong, Part, field_along, field_of_parts


@dataclass(frozen=True, slots=True, eq=False)
class MovingReference:
    """The reference that orbits of whatever age give at whatever times.

    Attributes
    ----------
    orbits, field
        What it is computed with.
    is_gcrf : bool
        Whether its components are asked for, and not its magnitude alone.
    along : FieldAlong, optional
        The field about the times that are expected, where there is one orbit and they are dense.
    """

    orbits: Sequence[Orbit]
    field: FieldModel
    is_gcrf: bool
    along: FieldAlong | None = None

    @classmethod
    def about(
        cls, t_utc: Times, orbits: Sequence[Orbit], field: FieldModel, *, is_gcrf: bool, uses: int
    ) -> MovingReference:
        """Return the reference; what will be asked for several times is made ready for some minute about ``t_utc``."""
        is_ready = len(orbits) == 1 and uses > 1
        along = field_along(orbits[0], field, t_utc, is_gcrf=is_gcrf, uses=uses) if is_ready else None
        return cls(orbits, field, is_gcrf, along)

    def at(self, t_utc: Times, q_base_gcrf: Floats | None) -> tuple[Floats, Floats | None]:
        """Return the magnitude of the field, shape (n,), nT, at ``t_utc``.

        And its components in the base frame, shape (n, 3), where there is an attitude: ``q_base_gcrf``, shape (n, 4).
        Positions are computed only where the field is not interpolated.

        Raises
        ------
        OrbitMissingError
            No orbit covers a time.
        ModelRangeError, PropagationError
            The field or the orbit cannot be had at a time or place.
        """
        magnitude_nt = np.empty(len(t_utc))
        b_base_nt = None if q_base_gcrf is None else np.empty((len(t_utc), 3))
        parts = self._parts(t_utc)
        for rows, b_nt in field_of_parts(t_utc, parts, self.field, is_gcrf=self.is_gcrf, known=self.along):
            magnitude_nt[rows] = lengths(b_nt)
            if q_base_gcrf is not None and b_base_nt is not None:
                b_base_nt[rows] = rotate_rows(q_base_gcrf[rows], b_nt)
        return magnitude_nt, b_base_nt

    def _parts(self, t_utc: Times) -> list[Part]:
        """Return which orbit gives which of the times their positions."""
        if len(self.orbits) == 1 and not isinstance(self.orbits[0], BoundedOrbit):
            return [Part(self.orbits[0], slice(0, len(t_utc)))]
        choice = choose_orbits(self.orbits, t_utc)
        if gap := np.count_nonzero(choice.index == NO_ORBIT):
            raise OrbitMissingError(f"no orbit covers {gap} of {len(t_utc)} times")
        return [Part.of(self.orbits[i], rows) for i, rows in choice.by_orbit()]

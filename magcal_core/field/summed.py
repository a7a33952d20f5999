"""A field of several parts: a main field, the degrees above it from a file, and the external field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds, Times
from magcal_core.field import FieldModel
from magcal_core.field.external import ExternalField
from magcal_core.field.file_model import FileField
from magcal_core.orbit.earth.timescales import nanoseconds


@dataclass(frozen=True, slots=True, eq=False)
class SummedField:
    """The sum of the parts that a name joins by ``+``.

    Attributes
    ----------
    main : FieldModel
        The field of the core.
    crust : FileField, optional
        Degrees of a file that ``main`` does not have.
    external : ExternalField, optional
    """

    main: FieldModel
    crust: FileField | None
    external: ExternalField | None

    @property
    def name(self) -> str:
        """Name of the model in records: ``igrf-14+file-60x60+rc``."""
        crust = [] if self.crust is None else [self.crust.name]
        external = [] if self.external is None else [self.external.kind]
        return "+".join([self.main.name, *crust, *external])

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc``, shape (n,), and ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT.

        Raises
        ------
        ModelRangeError
            A time or a place is outside the validity of a part.
        IndexRangeError
            The index has no value at a time.
        """
        field_nt = self.internal_itrf_nt(t_utc, r_itrf_km)
        if self.external is not None:
            places = np.ascontiguousarray(np.atleast_2d(r_itrf_km), np.float64)
            self.external.add_to(field_nt, nanoseconds(t_utc), places)
        return field_nt

    def internal_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the same without the external part."""
        field_nt = self.main.field_itrf_nt(t_utc, r_itrf_km)
        if self.crust is not None:
            field_nt += self.crust.field_itrf_nt(t_utc, r_itrf_km)
        return field_nt

    def corners_ns(self, first_ns: int, last_ns: int) -> Nanoseconds:
        """Return the times from ``first_ns`` to ``last_ns`` at which the field's change in time has a corner."""
        return np.zeros(0, np.int64) if self.external is None else self.external.corners_ns(first_ns, last_ns)

    def straight_at(self, stamp_ns: int) -> SummedField:
        """Return the field with the line that its index follows at ``stamp_ns`` drawn out beyond its corners."""
        external = None if self.external is None else self.external.straight_at(stamp_ns)
        return SummedField(self.main, self.crust, external)

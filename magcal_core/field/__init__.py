"""What the Earth's field was there: one file a model, over one kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class FieldModel(Protocol):
    """A model of the Earth's magnetic field."""

    @property
    def name(self) -> str:
        """Name of the model in records, such as ``igrf-14``."""
        ...

    def field_itrf_nt(self, t_utc: NDArray[np.datetime64], r_itrf_km: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the field at ``t_utc``, shape (n,), and ``r_itrf_km``, shape (n, 3): shape (n, 3), ITRF, nT.

        Raises
        ------
        ModelRangeError
            A time or a place is outside the model's validity.
        """
        ...

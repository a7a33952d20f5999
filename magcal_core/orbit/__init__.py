"""Where the satellite was: orbits from TLE, OMM, OEM, state vectors and numerical integration."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Orbit(Protocol):
    """One source of position."""

    @property
    def model(self) -> str:
        """What computes the position: ``sgp4``, ``numerical``, ``oem``."""
        ...

    @property
    def epoch_utc(self) -> np.datetime64:
        """Epoch of the elements or the state; its distance from the data is the orbit's age."""
        ...

    def position_itrf_km(self, t_utc: NDArray[np.datetime64]) -> NDArray[np.float64]:
        """Return the position at ``t_utc``, shape (n, 3), ITRF, km."""
        ...

    def state_gcrf(self, t_utc: NDArray[np.datetime64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), GCRF."""
        ...

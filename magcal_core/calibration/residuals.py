"""Residual tables and the statistics of residuals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel


@kernel(error_model="numpy")
def statistics(
    residuals: Floats, b: Floats, weights: Floats
) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """Return mean, variance, largest size and largest share of ``b`` of ``residuals``, shape (n, m), that have weight.

    Sums run over parts of 1024 samples, and those over all: their rounding does not grow with the session.
    """
    n, m = residuals.shape
    total, square, largest, share, count = 0.0, 0.0, 0.0, 0.0, 0
    for start in range(0, n, 1024):
        part = 0.0
        for i in range(start, min(n, start + 1024)):
            if weights[i] > 0.0:
                count += 1
                for j in range(m):
                    size = abs(residuals[i, j])
                    part += residuals[i, j]
                    largest = max(largest, size)
                    share = max(share, size / b[i])
        total += part
    count = max(count * m, 1)
    mean = total / count
    for start in range(0, n, 1024):
        part = 0.0
        for i in range(start, min(n, start + 1024)):
            if weights[i] > 0.0:
                for j in range(m):
                    part += (residuals[i, j] - mean) ** 2
        square += part
    return mean, square / count, largest, share


def residual_statistics(residuals_nt: Floats, b_nt: Floats, weights: Floats) -> ResidualStatistics:
    """Return the statistics of residuals, shape (n,) or (n, 3), nT, over all components of samples that have weight."""
    table = np.require(residuals_nt.reshape(len(b_nt), -1), np.float64, ["C", "W"])
    mean, spread, largest, share = statistics(table, b_nt, np.require(weights, np.float64, ["C", "W"]))
    return ResidualStatistics(
        mean, float(np.sqrt(spread)), float(np.hypot(mean, np.sqrt(spread))), largest, 100 * share
    )


@dataclass(frozen=True, slots=True)
class ResidualStatistics:
    """Statistics of a residual, nT; ``max_percent`` is the largest |residual| / |model|, in per cent."""

    mean_nt: float
    std_nt: float
    rms_nt: float
    max_abs_nt: float
    max_percent: float

    def to_dict(self) -> dict[str, float]:
        """Return the statistics as the records of the service have them."""
        return {name: getattr(self, name) for name in self.__slots__}


class Readings(Protocol):
    """Raw and corrected readings of every sample of a residual table: kept, or computed whenever they are asked for."""

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        ...

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        ...

    @property
    def corrected_base_nt(self) -> Floats | None:
        """Corrected reading T^-1 (h - b), shape (n, 3), base frame, nT; None where only magnitudes are known."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class StoredReadings:
    """`Readings` that were read from a file."""

    raw_nt: Floats
    corrected_nt: Floats
    corrected_base_nt: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ResidualTable:
    """Residual of every sample of a calibration, the left-out ones included, in time order.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (n,)
    model_nt : shape (n,)
        Magnitude of the reference field, nT; NaN where there is none.
    residual_nt : shape (n,) or (n, 3)
        |corrected| - |model| for scalar methods, corrected - model in the base frame for vector methods.
    weight : shape (n,)
        Weight of the sample in the fit, 0 where it was left out.
    flags : shape (n,)
        `SampleFlag` bits.
    readings : Readings
        Raw and corrected readings: where on the body sphere a residual arose.
    r_itrf_km : shape (n, 3), optional
        Position, ITRF, km: where over the Earth a residual arose.
    """

    t_utc: NDArray[np.datetime64]
    model_nt: Floats
    residual_nt: Floats
    weight: Floats
    flags: NDArray[np.uint16]
    readings: Readings
    r_itrf_km: Floats | None = None

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        return self.readings.raw_nt

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        return self.readings.corrected_nt

    @property
    def corrected_base_nt(self) -> Floats | None:
        """Corrected reading, shape (n, 3), base frame, nT; None where only magnitudes are known."""
        return self.readings.corrected_base_nt

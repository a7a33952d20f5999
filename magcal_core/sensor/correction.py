"""Readings to field, and lengths of vectors, in one pass: what residuals, tables and figures are made of."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.vectors import lengths
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import term_nt


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _correct(h: Floats, bias: Floats, lower: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(h.shape[0]):
        d1, d2, d3 = h[i, 0] - bias[0], h[i, 1] - bias[1], h[i, 2] - bias[2]
        out[i, 0] = lower[0, 0] * d1
        out[i, 1] = lower[1, 0] * d1 + lower[1, 1] * d2
        out[i, 2] = lower[2, 0] * d1 + lower[2, 1] * d2 + lower[2, 2] * d3


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def _corrected_lengths(h: Floats, bias: Floats, lower: Floats, out: Floats) -> None:  # pragma: no cover - compiled
    for i in range(h.shape[0]):
        d1, d2, d3 = h[i, 0] - bias[0], h[i, 1] - bias[1], h[i, 2] - bias[2]
        x = lower[0, 0] * d1
        y = lower[1, 0] * d1 + lower[1, 1] * d2
        z = lower[2, 0] * d1 + lower[2, 1] * d2 + lower[2, 2] * d3
        out[i] = math.sqrt(x * x + y * y + z * z)


def correct(h_nt: Floats, bias_nt: Floats, lower: Floats) -> Floats:
    """Return ``lower`` (h - b), shape (n, 3), nT; ``lower``: T^-1, lower triangular."""
    out = np.empty(h_nt.shape)
    _correct(np.require(h_nt, np.float64, ["C", "W"]), np.require(bias_nt, np.float64, ["C", "W"]), lower, out)
    return out


def corrected_lengths(h_nt: Floats, bias_nt: Floats, lower: Floats) -> Floats:
    """Return the lengths of ``lower`` (h - b), shape (n,), nT, without keeping the vectors."""
    out = np.empty(len(h_nt))
    h, bias = np.require(h_nt, np.float64, ["C", "W"]), np.require(bias_nt, np.float64, ["C", "W"])
    _corrected_lengths(h, bias, lower, out)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class FittedReadings:
    """Raw readings, shape (n, 3), nT, and regressors, with what ``parameters`` make of them when it is asked for."""

    h_nt: Floats
    regressors: Mapping[str, Floats]
    parameters: Parameters

    @property
    def raw_nt(self) -> Floats:
        """Magnitude of the raw reading, shape (n,), nT."""
        return lengths(self.h_nt)

    @property
    def corrected_nt(self) -> Floats:
        """Magnitude of the corrected reading, shape (n,), nT."""
        reading = readings_without(self.regressors, self.h_nt, self.parameters)
        return corrected_lengths(reading, self.parameters.bias_nt, _lower(self.parameters))

    @property
    def corrected_base_nt(self) -> Floats:
        """Corrected reading T^-1 (h - b - sum of regressor terms), shape (n, 3), base frame, nT."""
        reading = readings_without(self.regressors, self.h_nt, self.parameters)
        return correct(reading, self.parameters.bias_nt, _lower(self.parameters))


def _lower(parameters: Parameters) -> Floats:
    return parameters.correction_matrix


def readings_without(regressors: Mapping[str, Floats], h_nt: Floats, parameters: Parameters) -> Floats:
    """Return ``h_nt``, shape (n, 3), nT, less what ``parameters`` say that the ``regressors`` add; itself for none."""
    for name, coefficients in parameters.regressors.items():
        h_nt = h_nt - term_nt(regressors[name], coefficients)
    return h_nt

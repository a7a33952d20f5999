"""Samples: the one table that flows through the core, from the telemetry reader to the estimator."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.errors import TelemetryValueError

Flags = NDArray[np.uint16]


class SampleFlag(enum.IntFlag):
    """What is known against one sample; a sample is flagged, never edited."""

    NOT_FINITE = 1
    """time or reading is empty or not finite"""
    DUPLICATE_TIME = 2
    """same time and same values as an earlier sample"""
    CONFLICTING_TIME = 4
    """same time as another sample, other values"""
    SATURATED = 8
    """at or beyond the magnetometer's range, or at an extreme where readings pile up"""
    SPIKE = 16
    """far from the fit and from its neighbours"""
    JUMP = 32
    """at a step of the residual"""
    NO_REFERENCE = 64
    """a reference was sent for the table, but not for this sample"""
    NO_ATTITUDE = 128
    """the quaternion is missing or not a unit quaternion"""
    NO_HOUSEKEEPING = 256
    """a housekeeping column has no value here"""
    ZERO = 512
    """all three axes are exactly 0"""
    FILL_VALUE = 1024
    """an axis holds a number that loggers write for a missing reading, foreign among its neighbours"""
    STUCK = 2048
    """in a run of equal readings that chance does not make"""
    REPEATED = 4096
    """a reading that occurs far more often than others do"""
    FAR = 8192
    """beyond the reach of the field model, or where the field is less than a twentieth of the session's largest"""
    NOT_QUIET = 16384
    """only quiet hours were asked for, and this one is not known to be quiet"""
    BIAS_STEP = 32768
    """in one of the two blocks of time about a step of the bias that the fit has as an unknown"""


EXCLUDED: Final = (
    SampleFlag.NOT_FINITE
    | SampleFlag.DUPLICATE_TIME
    | SampleFlag.CONFLICTING_TIME
    | SampleFlag.SATURATED
    | SampleFlag.NO_REFERENCE
    | SampleFlag.NOT_QUIET
    | SampleFlag.BIAS_STEP
    | SampleFlag.ZERO
    | SampleFlag.FILL_VALUE
    | SampleFlag.STUCK
    | SampleFlag.REPEATED
    | SampleFlag.FAR
)
"""Flags that keep a sample out of every fit."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Telemetry of one magnetometer in time order, with whatever is known beside each reading.

    Attributes
    ----------
    t_utc : datetime64[ns], shape (n,)
        UTC.
    h_nt : shape (n, 3)
        Raw reading, nT, along the sensor's axes.
    q_base_gcrf : shape (n, 4), optional
        Unit quaternion, scalar first: ``v_base = C(q) v_gcrf``.
    b_ref_base_nt : shape (n, 3), optional
        True field in the magnetometer's base frame, nT.
    b_ref_gcrf_nt : shape (n, 3), optional
        True field in GCRF, nT.
    b_ref_magnitude_nt : shape (n,), optional
        True field magnitude, nT.
    r_itrf_km : shape (n, 3), optional
        Position, ITRF, km.
    housekeeping : name -> shape (n,)
        Other numeric columns, in the unit they were sent in.
    flags : uint16, shape (n,)
        `SampleFlag` bits.
    """

    t_utc: Times
    h_nt: Floats
    q_base_gcrf: Floats | None = None
    b_ref_base_nt: Floats | None = None
    b_ref_gcrf_nt: Floats | None = None
    b_ref_magnitude_nt: Floats | None = None
    r_itrf_km: Floats | None = None
    housekeeping: Mapping[str, Floats] = field(default_factory=dict)
    flags: Flags = field(default_factory=lambda: np.zeros(0, np.uint16))

    def __post_init__(self) -> None:
        n = len(self.t_utc)
        if self.flags.size == 0 and n:
            object.__setattr__(self, "flags", np.zeros(n, np.uint16))
        widths = {"h_nt": 3, "q_base_gcrf": 4, "b_ref_base_nt": 3, "b_ref_gcrf_nt": 3, "r_itrf_km": 3}
        columns = [(name, array, widths.get(name)) for name, array in self._own_columns().items()]
        columns += [(name, array, None) for name, array in self.housekeeping.items()]
        for name, array, width in columns:
            want = (n,) if width is None else (n, width)
            if array.shape != want:
                raise TelemetryValueError(f"column {name} has shape {array.shape}, want {want}")

    def __len__(self) -> int:
        return len(self.t_utc)

    def _own_columns(self) -> dict[str, NDArray[np.generic]]:
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "housekeeping"}
        return {name: array for name, array in own.items() if array is not None}

    @property
    def is_used(self) -> NDArray[np.bool_]:
        """Samples that no flag keeps out of a fit, shape (n,)."""
        used: NDArray[np.bool_] = (self.flags & np.uint16(EXCLUDED)) == 0
        return used

    @property
    def has_reference(self) -> bool:
        """Whether a reference field came with the telemetry, in any form."""
        given = (self.b_ref_base_nt, self.b_ref_gcrf_nt, self.b_ref_magnitude_nt)
        return any(column is not None for column in given)

    def take(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Samples:
        """Return the samples that ``index`` selects, columns and flags alike; a mask that keeps all copies nothing."""
        if selects_all(index):
            return self
        if isinstance(index, slice):
            own = {name: array[index] for name, array in self._own_columns().items()}
            keeping = {name: column[index] for name, column in self.housekeeping.items()}
        else:
            # Of vectors, numbers of rows are several times as fast as a mask, and `take` as brackets.
            rows = np.flatnonzero(index) if index.dtype == np.bool_ else index
            own = {name: array.take(rows, axis=0) for name, array in self._own_columns().items()}
            keeping = {name: column.take(rows) for name, column in self.housekeeping.items()}
        return Samples(**own, housekeeping=keeping)  # type: ignore[arg-type]

    def flagged(self, flag: SampleFlag, where: NDArray[np.bool_]) -> Samples:
        """Return the same samples with ``flag`` set where ``where`` is true."""
        return replace(self, flags=self.flags | np.where(where, np.uint16(flag), np.uint16(0)))


def selects_all(index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> bool:
    """Return whether ``index`` is a mask that keeps everything."""
    return isinstance(index, np.ndarray) and index.dtype == np.bool_ and bool(index.all())

"""The types of arrays and of callbacks that the core speaks of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Numbers; shape, unit and frame stand with each argument."""

Times = NDArray[np.datetime64]
"""Moments in UTC, datetime64[ns]."""

Mask = NDArray[np.bool_]
"""One answer a row."""

Nanoseconds = NDArray[np.int64]
"""Nanoseconds since 1970, or between two moments."""

Indices = NDArray[np.intp]
"""Places of rows."""

Complexes = NDArray[np.complex128]
"""Complex numbers: amplitudes of waves."""

Progress = Callable[[float], None]
"""Is called with the share of the work that is done, from 0 to 1."""

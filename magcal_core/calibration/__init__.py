"""Calibration methods: one file an estimator, one line an estimator in `ESTIMATORS`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from magcal_core.calibration.closed_form import ClosedFormFit
from magcal_core.calibration.fit import Estimator
from magcal_core.calibration.fit import Fit as Fit
from magcal_core.calibration.fit import FitSettings as FitSettings
from magcal_core.calibration.fit import FitStatus as FitStatus
from magcal_core.calibration.fit import Observations as Observations
from magcal_core.calibration.hooke_jeeves import HookeJeevesFit
from magcal_core.calibration.scalar import ScalarFit
from magcal_core.calibration.vector import VectorFit

ESTIMATORS: Final[Mapping[str, Estimator]] = MappingProxyType(
    {
        "scalar": ScalarFit(),
        "scalar-hooke-jeeves": HookeJeevesFit(),
        "vector": VectorFit(),
        "vector-closed-form": ClosedFormFit(),
    }
)
"""Calibration method -> its estimator."""

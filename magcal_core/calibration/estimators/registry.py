"""Calibration methods: one file an estimator, one line an estimator in `ESTIMATORS`."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from magcal_core.calibration.estimators.closed_form import ClosedFormFit
from magcal_core.calibration.estimators.contract import Estimator
from magcal_core.calibration.estimators.hooke_jeeves import HookeJeevesFit
from magcal_core.calibration.estimators.scalar import ScalarFit
from magcal_core.calibration.estimators.vector import VectorFit

ESTIMATORS: Final[Mapping[str, Estimator]] = MappingProxyType(
    {
        "scalar": ScalarFit(),
        "scalar-hooke-jeeves": HookeJeevesFit(),
        "vector": VectorFit(),
        "vector-closed-form": ClosedFormFit(),
    }
)
"""Calibration method -> its estimator."""

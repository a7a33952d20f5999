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
STEP_METHODS: Final = tuple(name for name, one in ESTIMATORS.items() if one.takes_regressors and one.has_moments)
"""Methods that can fit steps of the bias."""


def is_vector_method(method: object) -> bool:
    """Return whether ``method``, as a record names it, compares vectors; not one that is unknown."""
    return method in ESTIMATORS and ESTIMATORS[str(method)].is_vector


def has_moments(method: object) -> bool:
    """Return whether a fit by ``method``, as a record names it, has moments; not one that is unknown."""
    return method in ESTIMATORS and ESTIMATORS[str(method)].has_moments

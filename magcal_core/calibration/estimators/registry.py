"""Calibration methods: one file an estimator, one line an estimator in `ESTIMATORS`.

The names are known without the estimators: each is loaded when it is first asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from magcal_core.calibration.estimators.contract import Estimator


def _scalar() -> Estimator:
    from magcal_core.calibration.estimators.scalar import ScalarFit

    return ScalarFit()


def _hooke_jeeves() -> Estimator:
    from magcal_core.calibration.estimators.hooke_jeeves import HookeJeevesFit

    return HookeJeevesFit()


def _vector() -> Estimator:
    from magcal_core.calibration.estimators.vector import VectorFit

    return VectorFit()


def _closed_form() -> Estimator:
    from magcal_core.calibration.estimators.closed_form import ClosedFormFit

    return ClosedFormFit()


class Estimators(Mapping[str, "Estimator"]):
    """Estimators by name, each made when it is first asked for; the names alone load none."""

    def __init__(self, makers: Mapping[str, Callable[[], Estimator]]) -> None:
        self._makers = MappingProxyType(dict(makers))
        self._made: dict[str, Estimator] = {}

    def __getitem__(self, name: str) -> Estimator:
        """Return the estimator of that name."""
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is an estimator of that name."""
        return name in self._makers

    def __iter__(self) -> Iterator[str]:
        """Return the names in the order of the registry."""
        return iter(self._makers)

    def __len__(self) -> int:
        """Return how many estimators there are."""
        return len(self._makers)


ESTIMATORS: Final = Estimators(
    {
        "scalar": _scalar,
        "scalar-hooke-jeeves": _hooke_jeeves,
        "vector": _vector,
        "vector-closed-form": _closed_form,
    }
)
"""Calibration method -> its estimator."""


def step_methods() -> tuple[str, ...]:
    """Return the methods that can fit steps of the bias."""
    return tuple(name for name, one in ESTIMATORS.items() if one.takes_regressors and one.has_moments)


def is_vector_method(method: object) -> bool:
    """Return whether ``method``, as a record names it, compares vectors; not one that is unknown."""
    return method in ESTIMATORS and ESTIMATORS[str(method)].is_vector


def has_moments(method: object) -> bool:
    """Return whether a fit by ``method``, as a record names it, has moments; not one that is unknown."""
    return method in ESTIMATORS and ESTIMATORS[str(method)].has_moments

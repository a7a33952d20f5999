"""Does a new calibration say the same as the one in force? Parameters compared, and what of it reaches the field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.sessions.field_change import field_change
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import is_step

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.consistency import ParameterDifference
    from magcal_core.calibration.sessions.monitoring import ActiveSet

_COMPARED: Final = 9
"""Bias, scale factors and angles: a clock belongs to the orbit, and regressors move the bias."""


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """What separates a calibration from the one in force.

    Attributes
    ----------
    differences : tuple of ParameterDifference
        Every parameter: new - active, with the honest errors of both, most significant first.
    field_change_nt, field_change_error_nt : float
        The differences as a change of the corrected field, root mean square over all directions, nT.
    limit_nt : float
        Change up to which it does not matter: the residual of the set in force, or 1 % of the field, nT.
    p_value : float
        Of the most significant difference, over all parameters (Bonferroni).
    """

    differences: tuple[ParameterDifference, ...]
    field_change_nt: float
    field_change_error_nt: float
    limit_nt: float
    p_value: float

    @property
    def is_material(self) -> bool:
        """Whether the sensor has changed, or one of the two is wrong: significantly, and by more than the limit."""
        from magcal_core.calibration.sessions.monitoring import SIGNIFICANT_P

        return self.p_value < SIGNIFICANT_P and self.field_change_nt > self.limit_nt

    @property
    def text(self) -> str:
        """The comparison in words."""
        worst = self.differences[0]
        return (
            f"{worst.parameter} is {worst.difference:+.4g} from that of the set in force, {worst.sigmas:.1f} sigma; "
            f"the corrected field changes by {self.field_change_nt:.0f} +- {self.field_change_error_nt:.0f} nT, limit "
            f"{self.limit_nt:.0f} nT"
        )

    def to_dict(self) -> dict[str, object]:
        """Return the comparison as records have it."""
        return {
            "differs": self.is_material,
            "text": self.text,
            "p_value": self.p_value,
            "field_change_nt": self.field_change_nt,
            "field_change_error_nt": self.field_change_error_nt,
            "limit_nt": self.limit_nt,
            "differences": [one.to_dict() for one in self.differences],
        }


def agreement_with(
    active: ActiveSet, parameters: Parameters, covariance: Floats, mean_field_nt: float, *, is_vector: bool
) -> Agreement | None:
    """Return how ``parameters`` differ from the ``active`` ones; None where the two cannot be compared.

    They cannot where one is of a vector method and the other is not, where the regressors are others, where one has no
    errors, and where one alone says since when it drifts.

    ``covariance``: honest, shape (p, p), in the order of `Parameters.names`.

    Notes
    -----
    The axes of a vector calibration are those of the attitude, of a scalar one its own; and a bias beside other
    regressors is the bias at other values of them. Only what both have is compared: one may have a clock that the
    other lacks, and their regressors may stand in another order.
    """
    from magcal_core.calibration.sessions.monitoring import MATERIAL_SHARE, differences_of

    if is_vector is not active.is_vector or _kind(parameters) != _kind(active.parameters):
        return None
    if parameters.follows_time and (parameters.time_base_utc is None) is not (active.parameters.time_base_utc is None):
        return None
    active = active.at_time_base(parameters.time_base_utc)
    names = parameters.names[:_COMPARED]
    step = parameters.vector[:_COMPARED] - active.values_of(names)
    both = covariance[:_COMPARED, :_COMPARED] + active.covariance_of(names)
    if not np.isfinite(both).all():
        return None
    differences = differences_of(names, step, both, "new")
    size_nt, error_nt = field_change(active.parameters, mean_field_nt, step, both)
    return Agreement(
        differences,
        size_nt,
        error_nt,
        max(active.residual_rms_nt, MATERIAL_SHARE * mean_field_nt),
        min(1.0, _COMPARED * differences[0].p_value),
    )


def _kind(parameters: Parameters) -> set[str]:
    """Return the regressors that make the bias another one; a step inside the data does not: it is that after it."""
    return {name for name in parameters.regressors if not is_step(name)}

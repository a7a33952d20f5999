"""The parameters of one sensor as an estimator finds them, and their names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from magcal_core.arrays import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """Parameters of the sensor model h = T B + b, or their standard errors: the same shape serves both.

    Attributes
    ----------
    bias_nt : shape (3,)
        Zero offset b, nT.
    scale : shape (3,)
        Scale factors k.
    nonorthogonality_deg : shape (3,)
        Angles e1, e2, e3 of the sensing axes, deg.
    time_offset_s : float or None
        Seconds to add to the telemetry's clock to have the orbit's time; None where it was not estimated.
    regressors : name -> shape (3,)
        Change of the bias per unit of each regressor, nT per unit.
    """

    bias_nt: Floats
    scale: Floats
    nonorthogonality_deg: Floats
    time_offset_s: float | None = None
    regressors: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the covariance."""
        base = [f"{group}[{i}]" for group in ("bias_nt", "scale", "nonorthogonality_deg") for i in range(3)]
        extra = [f"regressors.{name}[{i}]" for name in self.regressors for i in range(3)]
        clock = [] if self.time_offset_s is None else ["time_offset_s"]
        return (*base, *extra, *clock)

    @property
    def vector(self) -> Floats:
        """The parameters in one array, in the order of `names`."""
        extra = [self.regressors[name] for name in self.regressors]
        clock = [] if self.time_offset_s is None else [np.array([self.time_offset_s])]
        return np.concatenate([self.bias_nt, self.scale, self.nonorthogonality_deg, *extra, *clock])

    def with_vector(self, values: Floats) -> Parameters:
        """Return parameters of the same shape with other ``values``, in the order of `names`."""
        names = list(self.regressors)
        regressors = {name: values[9 + 3 * i : 12 + 3 * i] for i, name in enumerate(names)}
        clock = None if self.time_offset_s is None else float(values[-1])
        return Parameters(values[0:3], values[3:6], values[6:9], clock, regressors)

    def to_dict(self) -> dict[str, object]:
        """Return the parameters as the records of the service have them."""
        return {
            "bias_nt": self.bias_nt.tolist(),
            "scale": self.scale.tolist(),
            "nonorthogonality_deg": self.nonorthogonality_deg.tolist(),
            "time_offset_s": self.time_offset_s,
            "regressors": {name: value.tolist() for name, value in self.regressors.items()},
        }

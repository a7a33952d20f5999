"""The parameters of one sensor as an estimator finds them, and their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import InputError
from magcal_core.sensor.model import SensorModel, inverse_lower, matrix_of_parameters
from magcal_core.sensor.regressors import OF_SCALE, TIME_REGRESSOR, hours_since, source_of
from magcal_core.units import utc_text

GROUPS: Final = ("bias_nt", "scale", "nonorthogonality_deg")
SENSOR_NAMES: Final = tuple(f"{group}[{i}]" for group in GROUPS for i in range(3))
"""The nine parameters of the sensor alone, in the order of a covariance."""
_SLOPE: Final = "regressors."
"""How the name of a regressor's coefficient begins."""


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
    time_base_utc : datetime64 or None
        Since when the regressor ``time`` counts its hours: bias and scale are those of that instant.
    """

    bias_nt: Floats
    scale: Floats
    nonorthogonality_deg: Floats
    time_offset_s: float | None = None
    regressors: Mapping[str, Floats] = field(default_factory=dict)
    time_base_utc: np.datetime64 | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the covariance."""
        extra = [f"{_SLOPE}{name}[{i}]" for name in self.regressors for i in range(3)]
        clock = [] if self.time_offset_s is None else ["time_offset_s"]
        return (*SENSOR_NAMES, *extra, *clock)

    @property
    def vector(self) -> Floats:
        """The parameters in one array, in the order of `names`."""
        extra = [self.regressors[name] for name in self.regressors]
        clock = [] if self.time_offset_s is None else [np.array([self.time_offset_s])]
        return np.concatenate([self.bias_nt, self.scale, self.nonorthogonality_deg, *extra, *clock])

    @property
    def matrix(self) -> Floats:
        """T, shape (3, 3): true field in the base frame to reading."""
        return matrix_of_parameters(self.scale, np.deg2rad(self.nonorthogonality_deg))

    @property
    def correction_matrix(self) -> Floats:
        """Inverse of T, shape (3, 3): reading to true field in the base frame."""
        return inverse_lower(self.matrix)

    @property
    def sensor(self) -> SensorModel:
        """The sensor alone, without clock and regressors.

        Raises
        ------
        OptionError
            These are not the parameters of a magnetometer: standard errors, or values that are not finite.
        """
        return SensorModel(self.bias_nt, self.scale, self.nonorthogonality_deg)

    def with_vector(self, values: Floats) -> Parameters:
        """Return parameters of the same shape with other ``values``, in the order of `names`."""
        names = list(self.regressors)
        regressors = {name: values[9 + 3 * i : 12 + 3 * i] for i, name in enumerate(names)}
        clock = None if self.time_offset_s is None else float(values[-1])
        return Parameters(values[0:3], values[3:6], values[6:9], clock, regressors, self.time_base_utc)

    @property
    def follows_time(self) -> bool:
        """Whether bias or scale change with the regressor ``time``."""
        return TIME_REGRESSOR in map(source_of, self.regressors)

    def at_time_base(self, time_base_utc: np.datetime64) -> Parameters:
        """Return the same sensor with ``time`` counted since another instant; itself where nothing counts so.

        Notes
        -----
        h (1 - c t) - b - d t = T B with t = t0 + t': divided by 1 - c t0 it has its old form in t', axis by axis.
        """
        if self.time_base_utc is None:
            return self
        hours = hours_since(time_base_utc, self.time_base_utc)
        share = 1.0 - hours * self.regressors.get(f"{TIME_REGRESSOR}{OF_SCALE}", np.zeros(3))
        bias_nt = self.bias_nt + hours * self.regressors.get(TIME_REGRESSOR, np.zeros(3))
        slopes = {name: slope / share for name, slope in self.regressors.items()}
        return replace(
            self, bias_nt=bias_nt / share, scale=self.scale / share, regressors=slopes, time_base_utc=time_base_utc
        )

    @classmethod
    def from_record(cls, record: Mapping[str, object]) -> Parameters:
        """Return the parameters of a parameter set's record, regressors in the order of its ``parameter_names``.

        The order of the keys of a JSON object says nothing: a database may give them back in another one, while the
        covariance keeps the order of ``parameter_names``.

        Raises
        ------
        InputError
            The record lacks what a parameter set has, or its ``parameter_names`` are not those of its regressors.
        """
        try:
            values = record["parameters"]
            if not isinstance(values, Mapping):
                raise InputError("the record is no parameter set: parameters are not a mapping")
            bias, scale, angles = (np.array(values[group], np.float64) for group in GROUPS)
            clock, base = values.get("time_offset_s"), values.get("time_base_utc")
            since = None if base is None else np.datetime64(str(base).removesuffix("Z"), "ns")
            slopes = {name: np.array(slope, np.float64) for name, slope in dict(values.get("regressors", {})).items()}
            order = _regressor_order(record.get("parameter_names"), slopes)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"the record is no parameter set: {error}") from error
        ordered = {name: slopes[name] for name in order}
        return cls(bias, scale, angles, None if clock is None else float(clock), ordered, since)

    def to_dict(self) -> dict[str, object]:
        """Return the parameters as the records of the service have them."""
        base = {} if self.time_base_utc is None else {"time_base_utc": utc_text(self.time_base_utc)}
        return {
            "bias_nt": self.bias_nt.tolist(),
            "scale": self.scale.tolist(),
            "nonorthogonality_deg": self.nonorthogonality_deg.tolist(),
            "time_offset_s": self.time_offset_s,
            "regressors": {name: value.tolist() for name, value in self.regressors.items()},
            **base,
        }


def _regressor_order(names: object, slopes: Mapping[str, Floats]) -> list[str]:
    """Return the regressors ``slopes`` in the order in which the ``parameter_names`` of a record have them.

    Without ``names`` the order is any: then nothing may be read from the record that relies on it.
    """
    if names is None:
        return list(slopes)
    own = [str(name) for name in names] if isinstance(names, Sequence) else []
    of_slopes = [name.removeprefix(_SLOPE).rpartition("[")[0] for name in own if name.startswith(_SLOPE)]
    order = list(dict.fromkeys(of_slopes))
    if set(order) != set(slopes):
        raise InputError("the record is no parameter set: parameter_names do not have its regressors")
    return order

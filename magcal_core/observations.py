"""The usable samples of a session as an estimator sees them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.errors import OptionError, OrbitMissingError, TelemetryValueError, TooFewSamplesError, UnitsError
from magcal_core.numerics.vectors import lengths
from magcal_core.samples import Samples, selects_all
from magcal_core.sensor.correction import FittedReadings
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import (
    RESPONSES,
    TIME_REGRESSOR,
    is_of_scale,
    is_response,
    is_step,
    regressor_of,
    source_of,
    step_column,
)
from magcal_core.units import NT_PER_UNIT

UNIT_RATIO: Final = (0.1, 10.0)
"""Where median |h| / |B| may lie: outside, the unit is wrong."""
STRONG: Final = 0.75
"""Share of the rows whose field is weaker than that in which a wrong unit must show as well."""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The usable samples as an estimator sees them, in time order.

    Attributes
    ----------
    t_s : shape (n,)
        Seconds since the first sample.
    h_nt : shape (n, 3)
        Raw reading, nT.
    b_nt : shape (n,)
        Magnitude of the true field, nT.
    b_base_nt : shape (n, 3), optional
        True field in the magnetometer's base frame, nT.
    weights : shape (n,)
        Prior weight of each sample; zero equals absent.
    regressors : name -> shape (n,), or (n, 3)
        Columns that may move the bias, and columns times the reading, which move the scale.
    rate_nt_s : shape (n, m)
        Fall of `b_nt` by each unknown of the clock (offset, s; drift, s/s): m = 0 where none is estimated.
    rate_base_nt_s : shape (n, m, 3), optional
        The same of `b_base_nt`.
    """

    t_s: Floats
    h_nt: Floats
    b_nt: Floats
    b_base_nt: Floats | None
    weights: Floats
    regressors: Mapping[str, Floats] = field(default_factory=dict)
    rate_nt_s: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    rate_base_nt_s: Floats | None = None

    def __post_init__(self) -> None:
        if self.rate_nt_s.size == 0:
            object.__setattr__(self, "rate_nt_s", np.zeros((len(self.t_s), 0)))

    def __len__(self) -> int:
        return len(self.t_s)

    @classmethod
    def of(cls, samples: Samples, regressors: Sequence[str] = (), weights: Floats | None = None) -> Observations:
        """Return the observations in ``samples`` whose flags let them be used.

        Raises
        ------
        OrbitMissingError
            The samples have no reference field.
        TelemetryValueError
            A value that is to be used is not finite, or no sample is usable.
        UnitsError
            The readings are out of all proportion to the field.
        OptionError
            A regressor is no column of the samples, or is constant.
        """
        prior = np.ones(len(samples)) if weights is None else np.asarray(weights, dtype=np.float64)
        is_used = samples.is_used & (prior > 0)
        if not is_used.any():
            raise TooFewSamplesError("no usable sample")
        used = samples.take(is_used)
        b_base = used.b_ref_base_nt
        magnitude = used.b_ref_magnitude_nt
        if magnitude is None:
            vector = b_base if b_base is not None else used.b_ref_gcrf_nt
            if vector is None:
                raise OrbitMissingError("the samples have no reference field")
            magnitude = np.linalg.norm(vector, axis=1)
        t_s = (used.t_utc - used.t_utc[0]) / np.timedelta64(1, "ns") * 1e-9
        columns = {name: _regressor(samples, is_used, name) for name in regressors}
        made = cls(
            t_s, _own(used.h_nt), _own(magnitude), None if b_base is None else _own(b_base), prior[is_used], columns
        )
        made._check()
        return made

    def _check(self) -> None:
        columns = [("h_nt", self.h_nt), ("reference", self.b_nt), ("weights", self.weights), *self.regressors.items()]
        if self.b_base_nt is not None:
            columns.append(("reference", self.b_base_nt))
        for name, column in columns:
            bad = ~np.isfinite(column)
            if bad.any():
                raise TelemetryValueError(f"{name}: {np.count_nonzero(bad)} values are not finite")
        if np.any(self.b_nt <= 0):
            raise TelemetryValueError("reference: a field magnitude is not positive")
        check_units(self.h_nt, self.b_nt)

    def take(self, index: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Observations:
        """Return the observations that ``index`` selects; a mask that keeps all copies nothing."""
        if selects_all(index):
            return self
        return Observations(
            self.t_s[index],
            _own(self.h_nt[index]),
            _own(self.b_nt[index]),
            None if self.b_base_nt is None else _own(self.b_base_nt[index]),
            self.weights[index],
            {name: column[index] for name, column in self.regressors.items()},
            _own(self.rate_nt_s[index]),
            None if self.rate_base_nt_s is None else _own(self.rate_base_nt_s[index]),
        )

    def with_regressors(self, names: Sequence[str]) -> Observations:
        """Return the observations with only the regressors ``names``, in that order."""
        return replace(self, regressors={name: self.regressors[name] for name in names})

    def require_vector(self) -> Floats:
        """Return the true field in the base frame, shape (n, 3), nT.

        Raises
        ------
        TelemetryValueError
            The samples have none: attitude is unknown.
        """
        if self.b_base_nt is None:
            raise TelemetryValueError(
                "the vector methods need the attitude (qw..qz) or the field in the base frame (ref_bx, ref_by, ref_bz)"
            )
        return self.b_base_nt


def _own(array: Floats) -> Floats:
    """Return ``array`` as the compiled kernels want it: contiguous, writable, float64; one compiled form serves all."""
    return np.require(array, np.float64, ["C", "W"])


def _regressor(samples: Samples, is_used: NDArray[np.bool_], name: str) -> Floats:
    """Return a regressor at the samples that are used; a lag reaches over samples that are not."""
    source = source_of(name)
    t_s = (samples.t_utc - samples.t_utc[is_used][0]) / np.timedelta64(1, "ns") * 1e-9
    columns = {TIME_REGRESSOR: t_s / 3600.0, **samples.housekeeping}
    if is_step(source):
        columns[source] = step_column(name, samples.t_utc)
    if is_response(name):
        # A slope reaches over readings that this fit leaves out, never over those that are none.
        good = samples.is_used
        return _own(regressor_of(name, columns, samples.h_nt[good], t_s[good])[is_used[good]])
    if source not in columns:
        known = ", ".join([TIME_REGRESSOR, *samples.housekeeping, *RESPONSES])
        raise OptionError(f"no housekeeping column {source!r}; there are {known}")
    column = np.asarray(columns[source], dtype=np.float64)[is_used]
    if source in samples.housekeeping and np.isfinite(column).all() and np.ptp(column) == 0.0:
        moved = "scale" if is_of_scale(name) else "bias"
        raise OptionError(f"regressor {name!r} is constant: it cannot be told from the {moved}")
    return _own(regressor_of(name, columns, samples.h_nt, t_s)[is_used])


def check_units(h_nt: Floats, b_nt: Floats) -> None:
    """Refuse readings ``h_nt``, shape (n, 3), that no unit error short of a wrong one explains beside ``b_nt``.

    Raises
    ------
    UnitsError
        |h| / |B| is outside `UNIT_RATIO` (`ratio_beyond`); the message names the unit that would fit.
    """
    ratio = ratio_beyond(h_nt, b_nt, UNIT_RATIO)
    if ratio is None:
        return
    fits = [unit for unit, factor in NT_PER_UNIT.items() if unit != "nT" and 0.3 <= ratio * factor <= 3.0]
    named = f"; a unit of {' or '.join(fits)} would fit" if fits else ""
    raise UnitsError(
        f"readings are {ratio:.3g} times the field, outside {UNIT_RATIO[0]}..{UNIT_RATIO[1]}: the unit is wrong{named}"
    )


def ratio_beyond(h_nt: Floats, b_nt: Floats, limits: tuple[float, float]) -> float | None:
    """Return the median of |h| / |B| where it is outside ``limits``, of all rows and of those in a strong field.

    None where it is not: beside the weak field of a far orbit a bias alone is many times as much, and no wrong unit.
    ``h_nt``, shape (n, 3), and ``b_nt``, shape (n,): nT.
    """
    ratios = lengths(np.ascontiguousarray(h_nt)) / b_nt
    ratio = float(np.median(ratios))
    if limits[0] <= ratio <= limits[1]:
        return None
    strong = float(np.median(ratios[b_nt >= np.quantile(b_nt, STRONG)]))
    return None if limits[0] <= strong <= limits[1] else ratio


def corrected_nt(observations: Observations, parameters: Parameters) -> Floats:
    """Return T^-1 (h - b - sum of regressor terms), shape (n, 3), nT, base frame."""
    return FittedReadings(observations.h_nt, observations.regressors, parameters).corrected_base_nt


def residuals_nt(observations: Observations, parameters: Parameters, is_vector: bool) -> Floats:
    """Return corrected - model, shape (n, 3), or |corrected| - |model|, shape (n,), nT."""
    readings = FittedReadings(observations.h_nt, observations.regressors, parameters)
    found, model = (
        (readings.corrected_base_nt, observations.require_vector())
        if is_vector
        else (readings.corrected_nt, observations.b_nt)
    )
    found -= model
    return found

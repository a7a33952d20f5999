"""The options of a calibration: their names, their defaults, what each may be."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, TypedDict

from magcal_core.errors import Fault, InputError, OptionError
from magcal_core.field.choices import INDEX_GAPS
from magcal_core.units import TIME_SCALES

ORBIT_MODELS: Final = ("sgp4", "numerical")
TIME_OFFSETS: Final = ("auto", "none", "estimate")
ROBUST_LOSSES: Final = ("auto", "none", "huber", "soft_l1", "cauchy", "tukey")
RESPONSES: Final = ("none", "auto")
GYRO_UNITS: Final = ("deg/s", "rad/s")
NOISE_MODELS: Final = ("auto", "none", "white")
LOCKED_TERMS: Final = ("auto", "none")
BIAS_STEPS: Final = ("auto", "fit", "none")


class OptionValues(TypedDict, total=False):
    """Options as keyword arguments or as the body of a job."""

    method: str
    field: str
    field_max_degree: int | None
    index_gap: str
    quiet_only: bool
    orbit: str
    time_offset: str
    time_drift: bool
    regressors: str | tuple[str, ...]
    response: str
    robust: str
    noise_model: str
    noise_nt: float | None
    integration_s: float | None
    bias_steps: str
    windows: float | str | None
    locked_terms: str
    without: tuple[str, ...]
    time_scale: str
    gyro: tuple[str, ...]
    gyro_unit: str
    max_orbit_age_days: float
    bootstrap: int
    seed: int


_IGRF_DEGREE: Final = 13


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """How to calibrate.

    Attributes
    ----------
    method : a key of `ESTIMATORS`.
    field, field_max_degree : field model by name; the degree that it, or its file, is cut at, None for its own.
    index_gap : ``refuse`` samples for which the index of the external field has no value, or take its ``mean``.
    quiet_only : use only samples of quiet hours, which needs Kp and an hourly index.
    orbit : ``sgp4`` as the elements are meant, or ``numerical`` integration from them.
    time_offset : ``none``, ``estimate``, or ``auto``: taken where the data show one that matters.
    time_drift : estimate a drift of the clock beside its offset.
    regressors : housekeeping columns that move the bias (``time``: hours since the first sample), or ``auto``;
        ``temperature*h``: that column moves the scale; ``torque_0@1``: one sample late; ``torque_*``: three columns of
        one stem; ``h^2``, ``h^3``, ``dh/dt``: responses of the sensor itself.
    response : whether ``auto`` tries these responses as well: ``none`` or ``auto``.
    robust : loss; ``auto``: none where the data are clean, else Tukey's from a start that half of the rows may be wrong
        for.
    noise_model : ``none``, ``white`` noise in the reading, or ``auto``: white where it moves a parameter by half its
        standard error.
    noise_nt : noise of one component, nT, where it is known.
    integration_s : seconds about its time stamp over which the sensor averages a reading; None or 0: none.
    bias_steps : ``auto``: look for steps of the bias inside the data and name them; ``fit``: fit them as well;
        ``none``.
    windows : hours of windows that are calibrated one by one beside the whole, with their trend, or ``auto``.
    locked_terms : ``auto``: errors of the bias that follow orbit, heat and sun are considered; ``none``: they are not.
    without : spans of time to leave out, each ``FROM/UNTIL`` in ISO 8601 with a zone, as if they had not been sent.
    time_scale : scale that the telemetry's clock keeps where its times were read as UTC and are not: ``gps``, ``tai``,
        ``tt``; its times are moved back to UTC, then ``without`` counts.
    gyro, gyro_unit : three columns of angular rate, and ``deg/s`` or ``rad/s``: they tell the mounting.
    max_orbit_age_days : orbits further from the data are refused.
    bootstrap : replicates of the block bootstrap, 0 for none; ``seed`` makes them repeatable.

    Raises
    ------
    OptionError
        A value that the option cannot have; ``faults`` name the options.
    """

    method: str = "scalar"
    field: str = "igrf"
    field_max_degree: int | None = None
    index_gap: str = "refuse"
    quiet_only: bool = False
    orbit: str = "sgp4"
    time_offset: str = "auto"
    time_drift: bool = False
    regressors: str | tuple[str, ...] = ()
    response: str = "none"
    robust: str = "auto"
    noise_model: str = "auto"
    noise_nt: float | None = None
    integration_s: float | None = None
    bias_steps: str = "auto"
    windows: float | str | None = None
    locked_terms: str = "auto"
    without: tuple[str, ...] = ()
    time_scale: str = "utc"
    gyro: tuple[str, ...] = ()
    gyro_unit: str = "deg/s"
    max_orbit_age_days: float = 14.0
    bootstrap: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("regressors", "without", "gyro"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        faults = [
            Fault(name, why, repr(getattr(self, name)))
            for name, check in _CHECKS.items()
            if (why := check(getattr(self, name))) is not None
        ]
        if not faults and "file" not in self.field and (self.field_max_degree or 1) > _IGRF_DEGREE:
            why = f"want a whole number from 1 to {_IGRF_DEGREE}, the degrees of {self.field}"
            faults = [Fault("field_max_degree", why, repr(self.field_max_degree))]
        if faults:
            raise OptionError("; ".join(f"{fault.where}: {fault.why}" for fault in faults), faults)

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> CalibrationOptions:
        """Return the options that ``values`` name; the others keep their defaults.

        Raises
        ------
        OptionError
            An unknown name, or a value that the option cannot have.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        unknown = [
            Fault(str(name), f"unknown option; known are {', '.join(known)}") for name in values if name not in known
        ]
        if unknown:
            raise OptionError("; ".join(f"{fault.where}: {fault.why}" for fault in unknown), unknown)
        return cls(**values)  # type: ignore[arg-type]

    @property
    def is_plain(self) -> bool:
        """Whether they ask for the plain fit of published figures, to the rows as they came."""
        is_bare = self.robust == self.noise_model == self.time_offset == "none"
        return is_bare and self.regressors == () and self.response == "none"

    def to_dict(self) -> dict[str, object]:
        """Return the options as the records of the service have them."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        regressors = self.regressors if isinstance(self.regressors, str) else list(self.regressors)
        return values | {"regressors": regressors, "without": list(self.without), "gyro": list(self.gyro)}


_Check = Callable[[object], str | None]


def _one_of(words: tuple[str, ...]) -> _Check:
    def check(value: object) -> str | None:
        return None if isinstance(value, str) and value in words else f"want one of {', '.join(words)}"

    return check


def _method(value: object) -> str | None:
    from magcal_core.calibration.estimators.registry import ESTIMATORS

    return _one_of(tuple(ESTIMATORS))(value)


def _field_name(value: object) -> str | None:
    from magcal_core.field.models import FIELD_MODELS, is_field_name

    return None if isinstance(value, str) and is_field_name(value) else f"want one of {', '.join(FIELD_MODELS)}"


def _number(lowest: float, highest: float, unit: str, *, may_be_none: bool = False) -> _Check:
    def check(value: object) -> str | None:
        if may_be_none and value is None:
            return None
        is_good = isinstance(value, (int, float)) and not isinstance(value, bool) and lowest <= value <= highest
        return None if is_good else f"want a number from {lowest:g} to {highest:g} {unit}".rstrip()

    return check


def _whole(lowest: int, highest: int, *, may_be_none: bool = False) -> _Check:
    def check(value: object) -> str | None:
        if may_be_none and value is None:
            return None
        is_good = isinstance(value, int) and not isinstance(value, bool) and lowest <= value <= highest
        return None if is_good else f"want a whole number from {lowest} to {highest}"

    return check


def _flag(value: object) -> str | None:
    return None if isinstance(value, bool) else "want true or false"


def _regressors(value: object) -> str | None:
    if value == "auto":
        return None
    is_good = isinstance(value, tuple) and all(isinstance(name, str) and name for name in value)
    if not is_good or not isinstance(value, tuple):
        return "want a list of column names, or auto"
    return None if len(set(value)) == len(value) else "a column is named twice"


def _windows(value: object) -> str | None:
    if value is None or value == "auto":
        return None
    return None if _number(0.1, 8784.0, "h")(value) is None else "want hours, a number from 0.1 to 8784, or auto"


def _without(value: object) -> str | None:
    from magcal_core.telemetry.spans import parse_spans

    if not isinstance(value, tuple) or not all(isinstance(span, str) for span in value):
        return "want a list of spans, each FROM/UNTIL"
    try:
        parse_spans(value)
    except InputError as error:
        return error.message
    return None


def _time_scale(value: object) -> str | None:
    return _one_of(TIME_SCALES)(value)


def _gyro(value: object) -> str | None:
    is_good = isinstance(value, tuple) and all(isinstance(name, str) and name for name in value)
    is_whole = isinstance(value, tuple) and len(set(value)) == len(value) and len(value) in (0, 3)
    return None if is_good and is_whole else "want three column names, one an axis"


_CHECKS: Final[Mapping[str, _Check]] = {
    "method": _method,
    "field": _field_name,
    "field_max_degree": _whole(1, 250, may_be_none=True),
    "index_gap": _one_of(INDEX_GAPS),
    "quiet_only": _flag,
    "orbit": _one_of(ORBIT_MODELS),
    "time_offset": _one_of(TIME_OFFSETS),
    "time_drift": _flag,
    "regressors": _regressors,
    "response": _one_of(RESPONSES),
    "robust": _one_of(ROBUST_LOSSES),
    "noise_model": _one_of(NOISE_MODELS),
    "noise_nt": _number(1e-6, 1e6, "nT", may_be_none=True),
    "integration_s": _number(0.0, 60.0, "s", may_be_none=True),
    "bias_steps": _one_of(BIAS_STEPS),
    "windows": _windows,
    "locked_terms": _one_of(LOCKED_TERMS),
    "without": _without,
    "time_scale": _time_scale,
    "gyro": _gyro,
    "gyro_unit": _one_of(GYRO_UNITS),
    "max_orbit_age_days": _number(0.0, 36525.0, "d"),
    "bootstrap": _whole(0, 10_000),
    "seed": _whole(0, 2**63 - 1),
}

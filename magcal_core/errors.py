"""The errors that magcal raises: each has a code that programs can read and a message with value, limit and unit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong in an input: where it stands and why it is wrong.

    ``value`` is for the person who holds the file; it never leaves through HTTP.
    """

    where: str
    why: str
    value: str | None = None

    def __str__(self) -> str:
        shown = "" if self.value is None else f" ({self.value!r})"
        return f"{self.where}: {self.why}{shown}"


class MagcalError(Exception):
    """Base of everything that magcal raises on purpose.

    ``diagnosis``: why a calibration was refused, and ``data_quality``: what its rows are worth, where they are known.
    """

    code: ClassVar[str] = "error"

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message
        self.diagnosis: Mapping[str, object] | None = None
        self.data_quality: Mapping[str, object] | None = None


class InputError(MagcalError):
    """The caller can mend it; ``faults`` lists what is wrong (the first 100)."""

    code = "input"

    def __init__(self, message: str, faults: Sequence[Fault] = ()) -> None:
        super().__init__(message)
        self.faults = tuple(faults[:100])


class TelemetryFormatError(InputError):
    """The bytes are not what their format says."""

    code = "telemetry_format"


class TooManyRowsError(TelemetryFormatError):
    """The table has more rows than one session may have."""

    code = "too_many_rows"


class TelemetryValueError(InputError):
    """The table can be read, but its values cannot be used."""

    code = "telemetry_value"


class TooManyBadSamplesError(TelemetryValueError):
    """More samples are flagged than a calibration may leave out."""

    code = "too_many_bad_samples"


class DecompressionLimitError(InputError):
    """A compressed body grows past the limit."""

    code = "decompression_limit"


class EncodingError(InputError):
    """The text is not UTF-8."""

    code = "encoding"


class UnitsError(InputError):
    """The unit is unknown, or the readings belie it; ``looks_like`` is the unit that they suit, where there is one."""

    code = "units_mismatch"

    def __init__(self, message: str, faults: Sequence[Fault] = (), looks_like: str | None = None) -> None:
        super().__init__(message, faults)
        self.looks_like = looks_like


class UnitsMissingError(UnitsError):
    """No unit was given, and there is no default."""

    code = "units_missing"


class FrameError(InputError):
    """A frame is unknown or not usable here."""

    code = "frame"


class TimeError(InputError):
    """A time cannot be read or is implausible."""

    code = "time"


class TimeZoneMissingError(TimeError):
    """A time without a zone."""

    code = "time_zone_missing"


class TimeConflictError(TimeError):
    """Too many samples claim the same time with different readings."""

    code = "time_conflict"


class OptionError(InputError):
    """An option has a value that it cannot have."""

    code = "option"


class OrbitFormatError(InputError):
    """An orbit message (OMM, OEM, state vector) is malformed."""

    code = "orbit_format"


class OrbitMissingError(InputError):
    """The telemetry has no reference field and there is no orbit to compute one from."""

    code = "orbit_missing"


class TleFormatError(InputError):
    """A TLE breaks its column format or has an element out of range."""

    code = "tle_format"


class TleChecksumError(TleFormatError):
    """The checksum digit of a TLE line does not match the line."""

    code = "tle_checksum"


class TleEpochError(InputError):
    """The TLE is too far in time from the telemetry."""

    code = "tle_epoch"


class MomentsError(InputError):
    """A file does not hold the moments of a fit, or holds them in a form of another version."""

    code = "moments"


class BeyondHistoryError(InputError):
    """The time is too far outside the history that a trend was made from."""

    code = "beyond_history"


class TooFewSetsError(InputError):
    """Fewer parameter sets count than a trend needs."""

    code = "too_few_sets"


class ModelRangeError(InputError):
    """Time or place is outside a model's validity."""

    code = "model_range"


class IndexFormatError(InputError):
    """An index file is not what its format says, or not one that magcal reads."""

    code = "index_format"


class IndexRangeError(InputError):
    """A sample lies where the index has no value; the message has the span of the index."""

    code = "index_range"


class IndexMissingError(InputError):
    """The field model or an option needs an index that is not there."""

    code = "index_missing"


class FieldFileError(InputError):
    """A file of coefficients is not what its format says, or lacks some."""

    code = "field_file"


class PropagationError(MagcalError):
    """An orbit could not be propagated; the message has the SGP4 code, the epoch and the time."""

    code = "propagation"


class EstimationError(MagcalError):
    """The data do not allow the estimate."""

    code = "estimation"


class TooFewSamplesError(EstimationError):
    """Fewer usable samples than the method needs."""

    code = "insufficient_samples"


class NotObservableError(EstimationError):
    """The data do not determine some parameters; ``parameters`` names them."""

    code = "not_observable"

    def __init__(self, message: str, parameters: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.parameters = tuple(parameters)


class WrongInputError(NotObservableError):
    """The data do not allow the estimate, and what is wrong with them has a name: ``diagnosis`` has it first."""

    code = "wrong_input"


class NoExcitationError(NotObservableError):
    """The reference field does not vary along an axis."""

    code = "no_excitation"


class CoplanarFieldError(NotObservableError):
    """The reference field stays in a plane; the message gives its normal."""

    code = "coplanar_field"


class DeadAxisError(NotObservableError):
    """A sensor axis does not respond to the field."""

    code = "dead_axis"

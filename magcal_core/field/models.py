"""Field models by name: a main field, and what is added to it.

Names are known without loading a model: what a model needs is loaded as it is made.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from magcal_core.errors import ModelRangeError, OptionError
from magcal_core.field import FieldModel
from magcal_core.field.choices import EXTERNAL_KINDS, INDEX_GAPS

if TYPE_CHECKING:
    import numpy as np

    from magcal_core.field.external import ExternalField
    from magcal_core.field.file_model import FileField
    from magcal_core.field.sources import FieldFile, FieldSources, GivenIndices


@dataclass(frozen=True, slots=True)
class MainField:
    """A model of the main field: ``make`` returns it whole.

    ``is_series``: an IGRF, which can be cut at a degree and frozen at a day, and to which a file's degrees are added.
    """

    make: Callable[[], FieldModel]
    is_series: bool = False


def _igrf() -> FieldModel:
    from magcal_core.field.igrf import Igrf

    return Igrf()


def _igrf_13() -> FieldModel:
    from magcal_core.field.igrf import Igrf

    return Igrf(version=13)


def _dipole() -> FieldModel:
    from magcal_core.field.dipole import DirectDipole

    return DirectDipole()


MAIN_FIELDS: Final[Mapping[str, MainField]] = {
    "igrf": MainField(_igrf, is_series=True),
    "igrf-14": MainField(_igrf, is_series=True),
    "igrf-13": MainField(_igrf_13, is_series=True),
    "dipole": MainField(_dipole),
}
"""Name -> the model at its full degree; ``igrf`` is the newest generation."""
_MAIN: Final = "|".join(map(re.escape, sorted(MAIN_FIELDS, key=len, reverse=True)))
_NAME: Final = re.compile(
    rf"(?:(?P<main>{_MAIN})"
    r"(?:-(?P<cut>\d{1,3})x(?P=cut))?(?:@(?P<day>\d{4}-\d{2}-\d{2}))?"
    r"(?P<crust>\+file(?:-(?P<crust_cut>\d{1,3})x(?P=crust_cut))?)?"
    r"|(?P<file>file)(?:-(?P<file_cut>\d{1,3})x(?P=file_cut))?)"
    rf"(?:\+(?P<external>{'|'.join(EXTERNAL_KINDS)}))?"
)


@dataclass(frozen=True, slots=True)
class FieldName:
    """A model's name taken apart.

    Attributes
    ----------
    main : str, optional
        A key of `MAIN_FIELDS`; None where a file is the main field.
    degree, day : degree that the main field is cut at, and the day that it is frozen at.
    has_file, file_degree : whether degrees of a file are added, or are the main field, and the degree they are cut at.
    external : a key of `EXTERNAL_KINDS`, or None.
    """

    main: str | None
    degree: int | None
    day: str | None
    has_file: bool
    file_degree: int | None
    external: str | None

    @classmethod
    def parse(cls, name: str) -> FieldName | None:
        """Return the parts of ``name``; None where it is no model's."""
        match = _NAME.fullmatch(name)
        if match is None:
            return None
        cut, file_cut = match["cut"], match["file_cut"] or match["crust_cut"]
        is_whole = match["main"] is not None and not MAIN_FIELDS[match["main"]].is_series
        if is_whole and (cut or match["day"] or match["crust"]):
            return None
        has_file = bool(match["file"] or match["crust"])
        degrees = [None if text is None else int(text) for text in (cut, file_cut)]
        return cls(match["main"], degrees[0], match["day"], has_file, degrees[1], match["external"])

    @property
    def needs(self) -> str | None:
        """The index that it needs, or None."""
        return None if self.external is None else EXTERNAL_KINDS[self.external]


def is_field_name(name: str) -> bool:
    """Return whether `field_model` knows the name."""
    return FieldName.parse(name) is not None


def field_model(
    name: str,
    max_degree: int | None = None,
    frozen_epoch: np.datetime64 | None = None,
    *,
    index: GivenIndices = None,
    field_file: FieldFile = None,
    index_gap: str = "refuse",
    sources: FieldSources | None = None,
) -> FieldModel:
    """Return the model of that name.

    The name may hold degree and epoch, as the names of cut and frozen models do: ``igrf-13-9x9@2020-01-01``; a file may
    add its degrees above 13 or be the main field, and an external field may come last: ``igrf-14+file-60x60+rc``.

    Parameters
    ----------
    max_degree, frozen_epoch
        Degree at which the main field, or the file where there is one, is cut; instant that the IGRF is frozen at.
    index : Index, path, bytes, open file, or several of them
        What the external field is driven by; of one kind the later holds, hour by hour.
    field_file : CoefficientFile, path, bytes or open file
        Coefficients, where the name has ``file``.
    index_gap : one of `INDEX_GAPS`
        What is done where the index has no value: ``refuse``, or ``mean`` for its mean.
    sources : FieldSources
        Both, where they are read already.

    Raises
    ------
    OptionError
        There is no such model, it has neither degree nor epoch to choose, or the file that it needs is not there.
    ModelRangeError
        The degree or the epoch is outside the model's range.
    IndexMissingError
        The index that it needs is not there.
    IndexFormatError, FieldFileError
        A file is none that magcal reads.
    """
    from magcal_core.field.sources import FieldSources

    parts = FieldName.parse(name)
    if parts is None:
        raise OptionError(f"unknown field model {name!r}; known are {', '.join(FIELD_MODELS)}")
    if index_gap not in INDEX_GAPS:
        raise OptionError(f"index_gap is {index_gap!r}; want one of {', '.join(INDEX_GAPS)}")
    given = FieldSources.of(index, field_file) if sources is None else sources
    if not parts.has_file and given.file is not None:
        raise OptionError(f"field: {name} takes no file of coefficients; name one that has +file, or file")
    if max_degree is not None:
        parts = replace(parts, file_degree=max_degree) if parts.has_file else replace(parts, degree=max_degree)
    main = _main(name, parts, frozen_epoch, given)
    crust = _crust(name, parts, given) if parts.has_file and parts.main is not None else None
    external = _external(name, parts, given, index_gap)
    if crust is None and external is None:
        return main
    from magcal_core.field.summed import SummedField

    return SummedField(main, crust, external)


def _main(name: str, parts: FieldName, frozen_epoch: np.datetime64 | None, given: FieldSources) -> FieldModel:
    if parts.main is None:
        from magcal_core.field.file_model import FileField

        if frozen_epoch is not None:
            raise OptionError(f"field model {name!r} has no epoch to choose")
        file = given.require_file(name)
        degree = _degree(parts.file_degree, file.min_degree, file.max_degree)
        return FileField(file, file.min_degree, degree, _file_name(parts.file_degree))
    model = MAIN_FIELDS[parts.main].make()
    day = _day(parts.day) if frozen_epoch is None and parts.day else frozen_epoch
    if parts.degree is None and day is None:
        return model
    from magcal_core.field.igrf import Igrf

    if not isinstance(model, Igrf):
        raise OptionError(f"field model {name!r} has no degree and no epoch to choose")
    if parts.has_file:
        raise OptionError(f"field model {name!r}: a file is added to the full IGRF, not to one that is cut or frozen")
    return Igrf(model.version, model.max_degree if parts.degree is None else parts.degree, day)


def _crust(name: str, parts: FieldName, given: FieldSources) -> FileField:
    from magcal_core.field.file_model import FileField
    from magcal_core.field.igrf import MAX_DEGREE

    file = given.require_file(name)
    if file.max_degree <= MAX_DEGREE:
        raise OptionError(f"field model {name!r}: the file has no degree above {MAX_DEGREE}, only to {file.max_degree}")
    low = max(file.min_degree, MAX_DEGREE + 1)
    return FileField(file, low, _degree(parts.file_degree, low, file.max_degree), _file_name(parts.file_degree))


def _external(name: str, parts: FieldName, given: FieldSources, index_gap: str) -> ExternalField | None:
    if parts.external is None:
        return None
    from magcal_core.field.external import ExternalField

    if parts.needs is None:
        return ExternalField.by_mean()
    return ExternalField.by_index(parts.external, given.require_hourly(parts.needs, f"field {name}"), index_gap)


def _degree(asked: int | None, lowest: int, highest: int) -> int:
    if asked is not None and not lowest <= asked <= highest:
        raise ModelRangeError(f"max_degree is {asked}; of this file want {lowest} to {highest}")
    return highest if asked is None else asked


def _file_name(degree: int | None) -> str:
    return "file" if degree is None else f"file-{degree}x{degree}"


def _day(text: str) -> np.datetime64:
    import numpy as np

    try:
        return np.datetime64(text, "ns")
    except ValueError as error:
        raise OptionError(f"field model: there is no day {text}") from error


FIELD_MODELS: Final[Mapping[str, Callable[..., FieldModel]]] = {
    name: partial(field_model, name)
    for name in (
        *MAIN_FIELDS,
        *(f"igrf-14+{kind}" for kind in EXTERNAL_KINDS),
        "file",
        "file-60x60",
        "igrf-14+file",
        "igrf-14+file-60x60",
    )
}
"""Name -> the model; what a name needs beside it, an index or a file, is given as to `field_model`."""

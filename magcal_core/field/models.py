"""Field models by name."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from magcal_core.errors import OptionError
from magcal_core.field import FieldModel
from magcal_core.field.dipole import DirectDipole
from magcal_core.field.igrf import Igrf

FIELD_MODELS: Final[Mapping[str, Callable[[], FieldModel]]] = {
    "igrf": Igrf,
    "igrf-14": Igrf,
    "igrf-13": lambda: Igrf(version=13),
    "dipole": DirectDipole,
}
"""Name -> the model at its full degree; ``igrf`` is the newest generation."""


_DETAILED: Final = re.compile(r"(igrf(?:-\d+)?)(?:-(\d{1,2})x\2)?(?:@(\d{4}-\d{2}-\d{2}))?")


def is_field_name(name: str) -> bool:
    """Return whether `field_model` knows the name: one of `FIELD_MODELS`, or one of these with degree and epoch."""
    match = _DETAILED.fullmatch(name)
    return name in FIELD_MODELS or (match is not None and match[1] in FIELD_MODELS)


def field_model(name: str, max_degree: int | None = None, frozen_epoch: np.datetime64 | None = None) -> FieldModel:
    """Return the model of that name, if asked truncated at ``max_degree`` and frozen at ``frozen_epoch``.

    The name may hold both, as the names of truncated and frozen models do: ``igrf-13-9x9@2020-01-01``.

    Raises
    ------
    OptionError
        There is no such model, or it has neither degree nor epoch to choose.
    ModelRangeError
        The degree or the epoch is outside the model's range.
    """
    if not is_field_name(name):
        raise OptionError(f"unknown field model {name!r}; known are {', '.join(FIELD_MODELS)}")
    match = _DETAILED.fullmatch(name)
    model = FIELD_MODELS[name if match is None else match[1]]()
    if match is not None:
        max_degree = int(match[2]) if max_degree is None and match[2] else max_degree
        frozen_epoch = _day(match[3]) if frozen_epoch is None and match[3] else frozen_epoch
    if max_degree is None and frozen_epoch is None:
        return model
    if not isinstance(model, Igrf):
        raise OptionError(f"field model {name!r} has no degree and no epoch to choose")
    return Igrf(model.version, model.max_degree if max_degree is None else max_degree, frozen_epoch)


def _day(text: str) -> np.datetime64:
    try:
        return np.datetime64(text, "ns")
    except ValueError as error:
        raise OptionError(f"field model: there is no day {text}") from error

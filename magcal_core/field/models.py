"""Field models by name."""

from __future__ import annotations

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


def field_model(name: str, max_degree: int | None = None, frozen_epoch: np.datetime64 | None = None) -> FieldModel:
    """Return the model of that name, if asked truncated at ``max_degree`` and frozen at ``frozen_epoch``.

    Raises
    ------
    OptionError
        There is no such model, or it has neither degree nor epoch to choose.
    ModelRangeError
        The degree or the epoch is outside the model's range.
    """
    if name not in FIELD_MODELS:
        raise OptionError(f"unknown field model {name!r}; known are {', '.join(FIELD_MODELS)}")
    model = FIELD_MODELS[name]()
    if max_degree is None and frozen_epoch is None:
        return model
    if not isinstance(model, Igrf):
        raise OptionError(f"field model {name!r} has no degree and no epoch to choose")
    degree = model.max_degree if max_degree is None else max_degree
    return Igrf(model.version, degree, frozen_epoch)

"""Tables of flight software: the numbers alone, in the convention ``on-board``, as single-precision floats.

``gomspace``: one ``set NAME[i] VALUE`` a line, as the parameter system of GomSpace's computers takes it on its console.
``fprime``: the JSON that F Prime's ``fprime-prm-write`` makes a parameter file from, the parameters of one component.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

Document = Mapping[str, object]
ON_BOARD: Final = "on-board"
"""The one convention of these tables."""
COMPONENT: Final = "magcal"
"""The instance whose parameters they are in F Prime's file; a deployment's own name is put in its place."""


def flight_numbers(document: Document) -> dict[str, list[float]]:
    """Return the numbers of a document of the convention ``on-board``: name -> its list, a matrix row by row.

    ``mgm_offset`` (nT), ``mgm_scale``, ``mgm_rotation``, and ``mgm_reg_NAME`` (nT per unit of the column) each.
    """
    parameters = document["parameters"]
    if not isinstance(parameters, Mapping):
        raise TypeError("a document without parameters")
    named = {"mgm_offset": parameters["bias_nt"], "mgm_scale": parameters["scale"]}
    named["mgm_rotation"] = [one for row in parameters["rotation"] for one in row]
    for name, values in parameters.get("regressors", {}).items():
        named[f"mgm_reg_{flight_name(name)}"] = values
    return {name: [float(one) for one in values] for name, values in named.items()}


def flight_name(name: str) -> str:
    """Return a regressor's name as flight software can have it."""
    return re.sub(r"[^a-z0-9]", "_", name.lower())


def single(value: float) -> str:
    """Return the shortest text that is ``value`` again as a single-precision float."""
    return str(np.float32(value))


def gomspace_table(document: Document) -> str:
    """Return the table as commands of a GomSpace console."""
    lines = [f"# {document['satellite']} {document['magnetometer']} parameter set {document['id']}"]
    lines += [f"# {document['formula']}"]
    for name, values in flight_numbers(document).items():
        lines += [f"set {name}[{number}] {single(value)}" for number, value in enumerate(values)]
    return "\n".join(lines) + "\n"


def fprime_parameters(document: Document) -> str:
    """Return the parameters as F Prime's tools read them: component, parameter, value."""
    numbers = flight_numbers(document)
    parts = (f"    {json.dumps(name.upper())}: [{', '.join(_json_singles(numbers[name]))}]" for name in numbers)
    return f'{{\n  "{COMPONENT}": {{\n' + ",\n".join(parts) + "\n  }\n}\n"


def _json_singles(values: list[float]) -> Iterator[str]:
    return (single(value) for value in values)

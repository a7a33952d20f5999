"""Examples for the OpenAPI document, made from its schemas: an example of a schema is valid by that schema."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

from pydantic import JsonValue

Schemas = Mapping[str, JsonValue]

TIME: Final = "2026-11-22T10:00:00.000000Z"
IDENTIFIER: Final = "01a22d2b2b147f2eadd36bad16da50ff"
BY_PATTERN: Final[Mapping[str, str]] = {
    "^[0-9a-f]{32}$": IDENTIFIER,
    "^[0-9a-f]{64}$": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
    "^[a-z0-9][a-z0-9._-]{0,62}$": "dekart",
}
BY_NAME: Final[Mapping[str, JsonValue]] = {
    "satellite": "dekart",
    "satellite_id": "dekart",
    "magnetometer": "mgm-1",
    "magnetometer_id": "mgm-1",
    "norad_id": "46493",
    "cospar_id": "2020-068H",
    "unit": "nT",
    "name": "DEKART",
    "field_model": "igrf-14",
    "orbit_model": "sgp4",
    "method": "scalar",
    "code": "tle_epoch",
    "detail": "the orbit's epoch is 20.0 d from the telemetry; limit 14 d",
    "bias_nt": [2928.0, -1191.0, -1876.0],
    "scale": [1.033, 1.007, 1.033],
    "nonorthogonality_deg": [-4.53, -1.07, 7.92],
    "position_km": [6771.2, 0.0, 0.0],
    "parameter_names": ["bias_nt[0]", "bias_nt[1]", "bias_nt[2]"],
    "residual_rms_nt": 97.2,
    "rms_nt": 97.2,
}
"""Values that say more than their type alone, taken where their schema allows them."""
DEEP: Final = 8


def example_of(schema: JsonValue, schemas: Schemas, name: str = "", depth: int = 0) -> JsonValue:
    """Return a value that ``schema`` allows, for a property ``name``; references are looked up in ``schemas``."""
    if not isinstance(schema, Mapping) or depth > DEEP:
        return None
    reference = schema.get("$ref")
    if isinstance(reference, str):
        return example_of(schemas[reference.rpartition("/")[2]], schemas, name, depth + 1)
    for given in ("const", "example"):
        if given in schema:
            return schema[given]
    for several in ("examples", "enum"):
        values = schema.get(several)
        if isinstance(values, Sequence) and values and not isinstance(values, str):
            return values[0]
    for choice in ("anyOf", "oneOf", "allOf"):
        parts = schema.get(choice)
        if isinstance(parts, Sequence) and not isinstance(parts, str):
            first = next((one for one in parts if one != {"type": "null"}), None)
            return example_of(first, schemas, name, depth + 1)
    return _of_type(schema, schemas, name, depth)


def _of_type(schema: Mapping[str, JsonValue], schemas: Schemas, name: str, depth: int) -> JsonValue:
    kind = schema.get("type")
    if kind == "object":
        return _object(schema, schemas, depth)
    if kind == "array":
        return _array(schema, schemas, name, depth)
    if kind == "string":
        return _text(schema, name)
    if kind == "boolean":
        return bool(schema.get("default", False))
    if kind in {"integer", "number"}:
        return _number(schema, name, is_whole=kind == "integer")
    return None


def _object(schema: Mapping[str, JsonValue], schemas: Schemas, depth: int) -> JsonValue:
    properties = schema.get("properties")
    if not isinstance(properties, Mapping):
        return {}
    return {name: example_of(one, schemas, name, depth + 1) for name, one in properties.items()}


def _array(schema: Mapping[str, JsonValue], schemas: Schemas, name: str, depth: int) -> JsonValue:
    known, items, parts = BY_NAME.get(name), schema.get("items"), schema.get("prefixItems")
    if isinstance(known, list) and _is_plain(items, known[0]) and "maxItems" not in schema:
        return known
    if isinstance(parts, Sequence) and not isinstance(parts, str):
        return [example_of(one, schemas, name, depth + 1) for one in parts]
    least = schema.get("minItems", 1)
    return [example_of(items, schemas, name, depth + 1) for _ in range(least if isinstance(least, int) else 1)]


def _is_plain(items: JsonValue, value: JsonValue) -> bool:
    """Return whether a schema is that of values such as ``value``, a number or a text, or of these and null."""
    parts = items.get("anyOf", [items]) if isinstance(items, Mapping) else []
    kinds = [one.get("type") for one in parts if isinstance(one, Mapping)] if isinstance(parts, list) else []
    return ("number" if isinstance(value, float) else "string") in kinds


def _text(schema: Mapping[str, JsonValue], name: str) -> str:
    if schema.get("format") == "date-time":
        return TIME
    pattern, known = schema.get("pattern"), BY_NAME.get(name)
    if isinstance(pattern, str):
        if isinstance(known, str) and re.search(pattern, known):
            return known
        return BY_PATTERN.get(pattern, pattern.removeprefix("^(").partition("|")[0].rstrip(")$"))
    if isinstance(known, str):
        return known
    if name == "id" or name.endswith("_id"):
        return IDENTIFIER
    return "text" if not isinstance(schema.get("default"), str) else str(schema["default"])


def _number(schema: Mapping[str, JsonValue], name: str, *, is_whole: bool) -> float | int:
    known, default = BY_NAME.get(name), schema.get("default")
    for value in (default, known):
        if isinstance(value, int | float) and not isinstance(value, bool):
            return value
    least = schema.get("minimum", schema.get("exclusiveMinimum", 0))
    above = (least if isinstance(least, int | float) else 0) + ("exclusiveMinimum" in schema)
    most = schema.get("maximum")
    value = max(above, 1) if not isinstance(most, int | float) else min(max(above, 1), most)
    return int(value) if is_whole else float(value)

"""Documents as JSON can say them."""

from __future__ import annotations

import math
from collections.abc import Mapping


def without_nan(value: object) -> object:
    """Return a document with null in place of the numbers that JSON cannot say."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(one) for one in value]
    return value

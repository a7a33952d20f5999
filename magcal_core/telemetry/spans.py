"""Spans of time as text, FROM/UNTIL, and which times lie in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from magcal_core.arrays import Mask, Times
from magcal_core.errors import InputError, OptionError, TimeError
from magcal_core.telemetry.iso_times import parse_iso_time

Span = tuple[np.datetime64, np.datetime64]
"""From a time on, until before another, UTC."""
MOST_SPANS: Final = 100


def parse_span(text: str) -> Span:
    """Return the two times of a span ``FROM/UNTIL``, ISO 8601 with a zone, in UTC.

    Raises
    ------
    TimeError
        The text is no span; the message says what is wanted.
    OptionError
        It ends before it begins.
    """
    parts = text.split("/")
    if len(parts) != 2:
        raise TimeError("want FROM/UNTIL, two times in ISO 8601 with Z and a slash between them")
    try:
        begin, end = (parse_iso_time(part.strip()) for part in parts)
    except InputError as error:
        raise TimeError(f"want FROM/UNTIL: {error.message}") from error
    if not begin < end:
        raise OptionError("a span of time ends before it begins")
    return begin, end


def parse_spans(texts: Sequence[str]) -> tuple[Span, ...]:
    """Return the spans that ``texts`` are.

    Raises
    ------
    TimeError, OptionError
        One of them is no span, or there are more than `MOST_SPANS`.
    """
    if len(texts) > MOST_SPANS:
        raise OptionError(f"{len(texts)} spans of time, limit {MOST_SPANS}")
    return tuple(parse_span(text) for text in texts)


def in_spans(t_utc: Times, spans: Sequence[Span]) -> Mask:
    """Return which of ``t_utc``, shape (n,), lie in one of ``spans``, shape (n,): the last time of each excluded."""
    inside = np.zeros(len(t_utc), dtype=bool)
    for begin, end in spans:
        inside |= (t_utc >= begin) & (t_utc < end)
    return inside

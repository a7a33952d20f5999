"""The rows that a calibration is asked to use: their times in the scale that its clock keeps, spans left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from magcal_core.errors import TooFewSamplesError
from magcal_core.samples import Samples
from magcal_core.telemetry.spans import in_spans, parse_spans
from magcal_core.telemetry.times import in_utc_ns


class RowOptions(Protocol):
    """What the options of a calibration say of its rows."""

    @property
    def without(self) -> Sequence[str]:
        """Spans of time to leave out, each ``FROM/UNTIL``, UTC."""
        ...

    @property
    def time_scale(self) -> str:
        """Scale that the clock keeps whose times were read as UTC."""
        ...


def rows_asked_for(samples: Samples, options: RowOptions) -> Samples:
    """Return ``samples`` with their times moved from the scale that their clock keeps, without the spans left out.

    Raises
    ------
    TooFewSamplesError
        The spans leave nothing.
    """
    moved = samples
    if options.time_scale != "utc":
        t_ns = samples.t_utc.astype("datetime64[ns]").view(np.int64)
        utc_ns = in_utc_ns(t_ns, options.time_scale)
        moved = replace(samples, t_utc=utc_ns.view("datetime64[ns]"))
    if not options.without:
        return moved
    kept = moved.take(~in_spans(moved.t_utc, parse_spans(options.without)))
    if len(samples) and not len(kept):
        raise TooFewSamplesError("without: the spans left out hold every sample")
    return kept


def warnings_of_rows(samples: Samples, kept: Samples, options: RowOptions) -> Iterator[str]:
    """Say what `rows_asked_for` has done to ``samples``, of which it kept ``kept``."""
    if options.time_scale != "utc":
        yield f"times_as_asked: the telemetry's times were taken as {options.time_scale.upper()} time and moved to UTC"
    if options.without:
        left_out = len(samples) - len(kept)
        yield f"spans_left_out: {left_out} of {len(samples)} samples lie in the spans that were to be left out"

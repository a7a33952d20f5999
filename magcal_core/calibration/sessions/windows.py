"""Long sessions in windows: non-overlapping spans, each a calibration of its own, and the trend of them all.

Notes
-----
Short windows lose nothing: over six days, the trend of windows of 1.6 to 6.4 h errs alike where the bias walks slowly,
and that of the shorter ones less where it walks fast (`docs/time.md`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from magcal_core.calibration.reasons import Verdict
from magcal_core.calibration.sessions.trend import Trend, trend
from magcal_core.errors import EstimationError, InputError, OptionError, TooFewSetsError
from magcal_core.samples import Samples
from magcal_core.units import utc_text

FEWEST: Final = 3
ORBITS_A_WINDOW: Final = 2.0
PERIOD_S: Final = 5760.0
"""Period of an orbit, s, where none is known: that of 550 km."""
_REFUSED_SHARE: Final = 0.5
_MOST_SHARE: Final = 1.0 / 3.0
_REASONS: Final = 3
_ENOUGH: Final = 0.02
"""Share of a window that the last one may lack: the last sample is a step short of its end."""
_HALF: Final = 0.5


class Calibrated(Protocol):
    """A calibration, as far as windows need it."""

    @property
    def verdict(self) -> Verdict:
        """What is said of it in one word."""
        ...

    def to_dict(self) -> dict[str, object]:
        """Return the record."""
        ...


Calibrate = Callable[[Samples], Calibrated]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One window: its span, and its calibration or why there is none."""

    begin: np.datetime64
    end: np.datetime64
    calibration: Calibrated | None
    error: str | None

    @property
    def is_refused(self) -> bool:
        """Whether nothing can be said from this window."""
        return self.calibration is None or self.calibration.verdict.grade == "refuse"

    def to_dict(self) -> dict[str, object]:
        """Return the window as the record has it: what a trend needs of a set."""
        if self.calibration is None:
            return {"from": utc_text(self.begin), "until": utc_text(self.end), "error": self.error}
        record = self.calibration.to_dict()
        kept = ("verdict", "data_from", "data_until", "method", "parameters", "standard_errors", "parameter_names")
        return {
            "from": utc_text(self.begin),
            "until": utc_text(self.end),
            **{name: record[name] for name in (*kept, "covariance", "statistics", "bias_steps") if name in record},
        }


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """A session in windows of ``hours``, and their trend."""

    hours: float
    items: tuple[Window, ...]
    trend: Trend

    def to_dict(self) -> dict[str, object]:
        """Return the windows as the record has them."""
        return {
            "hours": self.hours,
            "items": [window.to_dict() for window in self.items],
            "trend": self.trend.to_dict(),
        }


def windows_of(samples: Samples, hours: float | str, calibrate: Calibrate, period_s: float | None = None) -> Windows:
    """Return the windows of ``samples``, which are in time order, each calibrated by ``calibrate``.

    ``hours``: length of a window; ``auto``: twice the orbit's period, doubled until half the windows are not refused, a
    third of the session at most. ``period_s``: of the orbit, where it is known.

    Raises
    ------
    OptionError
        There are fewer than three windows.
    TooFewSetsError
        Fewer than three windows can be calibrated.
    """
    t_utc = samples.t_utc[~np.isnat(samples.t_utc)]
    if not len(t_utc):
        raise OptionError("windows: there are no samples")
    span_h = float((t_utc[-1] - t_utc[0]) / np.timedelta64(1, "ns")) / 3.6e12
    if hours != "auto":
        return _made(samples, float(hours), _cut(samples, float(hours), span_h, calibrate))
    length = ORBITS_A_WINDOW * (PERIOD_S if period_s is None else period_s) / 3600.0
    while True:
        items = _cut(samples, length, span_h, calibrate)
        refused = sum(window.is_refused for window in items)
        if refused <= _REFUSED_SHARE * len(items) or 2.0 * length > span_h * _MOST_SHARE:
            return _made(samples, length, items)
        length *= 2.0


def _made(samples: Samples, hours: float, items: Sequence[Window]) -> Windows:
    sets = [window.calibration for window in items if window.calibration is not None]
    good = sum(not window.is_refused for window in items)
    if good < FEWEST:
        reasons = dict.fromkeys(window.error for window in items if window.error is not None)
        told = f": {'; '.join(list(reasons)[:_REASONS])}" if reasons else ""
        raise TooFewSetsError(f"windows: {good} of {len(items)} can be calibrated, {FEWEST} are needed{told}")
    return Windows(hours, tuple(items), trend(sets, at=samples.t_utc[-1]))


def _cut(samples: Samples, hours: float, span_h: float, calibrate: Calibrate) -> list[Window]:
    """Return the windows of ``hours``; what is left at the end, if it is half of one or more, is one as well."""
    count = int(span_h / hours + _ENOUGH)
    if count < FEWEST:
        raise OptionError(f"windows: {span_h:.2g} h make {count} windows of {hours:.3g} h, {FEWEST} are needed")
    count += span_h / hours - count >= _HALF
    begin = samples.t_utc[0]
    length = np.timedelta64(round(hours * 3.6e12), "ns")
    found = []
    for i in range(count):
        first, last = begin + i * length, begin + (i + 1) * length
        is_inside = (samples.t_utc >= first) & (samples.t_utc < last)
        if i == count - 1:
            is_inside |= samples.t_utc >= last
        if is_inside.any():
            found.append(_window(samples.take(is_inside), first, last, calibrate))
    return found


def _window(samples: Samples, begin: np.datetime64, end: np.datetime64, calibrate: Calibrate) -> Window:
    try:
        return Window(begin, end, calibrate(samples), None)
    except (InputError, EstimationError) as error:
        return Window(begin, end, None, f"{error.code}: {error.message}")

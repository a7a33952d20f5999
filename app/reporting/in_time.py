"""What a report says of a magnetometer in time: the trend of its parameter sets, in words and as a figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magcal_core.calibration.sessions.trend import Trend


@dataclass(frozen=True, slots=True)
class SensorInTime:
    """The trend of a magnetometer, as the service answers it, and its figure as plotly draws it; or why there is none.

    Attributes
    ----------
    trend, figure : mappings, optional
        None where no trend can be told.
    why_not : str
        Why; empty where there is one.
    """

    trend: Mapping[str, Any] | None
    figure: Mapping[str, Any] | None
    why_not: str = ""

    @classmethod
    def of_trend(cls, found: Trend) -> SensorInTime:
        """Return what is said of a trend that is at hand."""
        from app.reporting.figures import trend_figure

        return cls(found.to_dict(), trend_figure(found).to_plotly_json())

    @classmethod
    def untold(cls, why_not: str) -> SensorInTime:
        """Return that no trend can be told, and why."""
        return cls(None, None, why_not)

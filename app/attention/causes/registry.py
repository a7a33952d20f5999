"""The causes of attention, the most pressing first: a cause is one class and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from app.attention.causes.aboard import NotAboard
from app.attention.causes.ages import DataStale, OrbitStale, StationSilent
from app.attention.causes.contract import Cause, Severity
from app.attention.causes.forecast import ForecastOut
from app.attention.causes.job_failed import JobFailed
from app.attention.causes.orbits import OrbitMissing, OrbitOtherObject
from app.attention.causes.session_verdicts import SessionVerdict
from app.attention.causes.set_verdicts import ActiveWeak, NoActiveSet, SetRefused

CAUSES: Final[Mapping[str, Cause]] = {
    "session_disagrees": SessionVerdict("disagrees", "disagrees with the set in force", Severity.ACT),
    "orbit_other_object": OrbitOtherObject(),
    "orbit_missing": OrbitMissing(),
    "job_failed": JobFailed(),
    "set_refused": SetRefused(),
    "no_active_set": NoActiveSet(),
    "active_weak": ActiveWeak(),
    "forecast_out": ForecastOut(),
    "session_watch": SessionVerdict("watch", "is to be watched under the set in force", Severity.WATCH),
    "not_aboard": NotAboard(),
    "station_silent": StationSilent(),
    "orbit_stale": OrbitStale(),
    "data_stale": DataStale(),
}

"""What runs in the child for a monitoring: sessions and a set's record in, a judgement each out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from app.jobs.kinds.contract import Outcome, Report, WrongKindError
from app.jobs.kinds.monitoring import ORBIT_AGE_DAYS, MonitoringWork, SessionToJudge
from app.orbits.parsing import orbit_of
from app.records.json_numbers import without_nan
from app.sessions.repository import samples_of
from magcal_core.errors import MagcalError
from magcal_core.sessions import monitor

NOT_JUDGED: Final = "not_judged"


def judge(work: object, report: Report) -> Outcome:
    """Return what each session says of the parameter set; where one cannot be judged, why."""
    if not isinstance(work, MonitoringWork):
        raise WrongKindError("not a monitoring")
    judged: dict[str, object] = {}
    for number, one in enumerate(work.sessions):
        judged[one.session_id] = _judgement(one, work.record or {})
        report((number + 1) / len(work.sessions))
    return Outcome({"parameter_set_id": work.parameter_set_id, "sessions": judged})


def _judgement(one: SessionToJudge, record: Mapping[str, object]) -> object:
    if one.problem is not None:
        return _not_judged(one.problem)
    try:
        samples = samples_of(one.columns)
        orbits = [orbit_of(content) for content in one.orbits]
        return without_nan(monitor(samples, orbits, record, max_orbit_age_days=ORBIT_AGE_DAYS).to_dict())
    except MagcalError as error:
        return _not_judged(f"{error.code}: {error}")


def _not_judged(why: str) -> dict[str, object]:
    return {"grade": NOT_JUDGED, "reasons": [why], "samples": 0, "residual_rms_nt": None, "residual_ratio": None}

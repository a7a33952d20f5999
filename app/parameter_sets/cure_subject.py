"""What the cures of a parameter set's reasons go by: its record, its sessions and the orbits that there are now."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.errors import StoredObjectCorruptError
from app.http.schemas import core_times, parse_utc
from app.indices.repository import FIELD_FILE
from app.indices.tables import FieldFile
from app.orbits.nearest import chosen
from app.orbits.objects import difference
from app.orbits.repository import OrbitRepository
from app.orbits.tables import OrbitRow
from app.parameter_sets.reasons import Subject
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.tables import ParameterSet
from app.records.calibration_options import as_asked
from app.satellites.repository import SatelliteRepository
from app.sessions.tables import TelemetrySession
from magcal_core.options import CalibrationOptions

READINGS: Final = re.compile(r"time|[bq][wxyz]|ref_.*|[xyz]_km")
"""Columns that are no housekeeping."""
NEAR_DAYS: Final = CalibrationOptions().max_orbit_age_days
"""How far an orbit may be from the data that is looked for."""
OFFSET_ERROR_S: Final = 1.0 / 3.0
"""Standard error, s, that an offset of a diagnosis is held against the scales with: it was looked for by the second."""
SCALES: Final = {f"{scale.upper()} time": scale for scale in ("gps", "tai", "tt")}
"""What a suspicion calls a scale -> the option."""


def subject_of(session: Session, caller: Caller, row: ParameterSet) -> Subject:
    """Return what the cures of ``row`` go by.

    Raises
    ------
    StoredObjectCorruptError
        The record has no provenance.
    """
    sets = ParameterSetRepository(session, caller)
    active = sets.in_force(row.satellite_id, row.magnetometer_id)
    sessions = [session.get_one(TelemetrySession, one) for one in sets.session_ids([row])[row.id]]
    provenance = row.record["provenance"]
    if not isinstance(provenance, Mapping):
        raise StoredObjectCorruptError("the parameter set's record has no provenance")
    return Subject(
        parameter_set_id=row.id,
        satellite_id=row.satellite_id,
        session_ids=[one.id for one in sessions],
        options=_options(session, provenance),
        housekeeping=[name for one in sessions for name in one.columns if not READINGS.fullmatch(name)],
        active_id=None if active is None else active.id,
        time_scale=_suspected_scale(row.record),
        stretches=_stretches(row.record),
        has_outliers=_is_warned(row.record, "outliers: "),
        nearer_orbit=_nearer_orbit(session, row, sessions, _parts(provenance, "orbits")),
    )


def _options(session: Session, provenance: Mapping[str, object]) -> dict[str, object]:
    """Return the options that the set was made with, as the request of a job carries them."""
    given = provenance.get("options")
    known = {one.name for one in fields(CalibrationOptions)}
    named = {name: value for name, value in given.items() if name in known} if isinstance(given, Mapping) else {}
    asked = as_asked(CalibrationOptions.from_dict(named))
    file = provenance.get("field_file")
    if isinstance(file, Mapping):
        asked[FIELD_FILE] = session.scalar(select(FieldFile.id).where(FieldFile.sha256 == file["sha256"]))
    return asked


def _parts(of: Mapping[str, object], name: str) -> list[Mapping[str, object]]:
    """Return the mappings of a list in a record; sets from before it was kept have none."""
    found = of.get(name)
    return [one for one in found if isinstance(one, Mapping)] if isinstance(found, list) else []


def _suspected_scale(record: Mapping[str, object]) -> str | None:
    """Return the time scale that a suspicion names, or that the seconds of a diagnosis are off by."""
    for one in _parts(record, "suspicions"):
        if one.get("code") == "time_scale_suspect":
            return SCALES.get(str(one.get("candidate")))
    diagnosis = record.get("diagnosis")
    findings = _parts(diagnosis, "findings") if isinstance(diagnosis, Mapping) else []
    return None if not findings else scale_of_clock(findings[0], _time(record["data_from"]))


def scale_of_clock(finding: Mapping[str, object], at: datetime) -> str | None:
    """Return the time scale that the clock keeps by a finding of a diagnosis; None where it is another offset."""
    from magcal_core.calibration.diagnosis.wrong_input.time_scale import scale_of_offset

    value = finding.get("value")
    if finding.get("code") != "clock" or not isinstance(value, int | float):
        return None
    return scale_of_offset(core_times([at])[0], -float(value), OFFSET_ERROR_S)


def _is_warned(record: Mapping[str, object], begin: str) -> bool:
    warnings = record.get("warnings")
    return isinstance(warnings, list) and any(str(one).startswith(begin) for one in warnings)


def _stretches(record: Mapping[str, object]) -> list[tuple[datetime, datetime]]:
    quality = record.get("data_quality")
    found = _parts(quality, "rejected_stretches") if isinstance(quality, Mapping) else []
    return [(_time(one["from"]), _time(one["until"])) for one in found]


def _time(text: object) -> datetime:
    found = parse_utc(text)
    if not isinstance(found, datetime):
        raise StoredObjectCorruptError("a time of the parameter set's record is none")
    return found


def _nearer_orbit(
    session: Session, row: ParameterSet, sessions: Sequence[TelemetrySession], used: Sequence[Mapping[str, object]]
) -> datetime | None:
    """Return the epoch of an orbit that is nearer to the data than those used, where one has come since."""
    if not used:
        return None
    satellite = SatelliteRepository(session, SYSTEM).get(row.satellite_id)
    orbits, ids = OrbitRepository(session, SYSTEM, satellite.id), {one.get("id") for one in used}
    oldest_days = max(float(str(one["age_days"])) for one in used)
    for one in sessions:
        if one.data_from is None or one.data_until is None:
            continue
        own = [found for found in orbits.around(one.data_from, one.data_until, NEAR_DAYS)
               if difference(satellite, found.details) is None]  # fmt: skip
        best = chosen(own, one.data_from)
        if best is not None and best.id not in ids and _age_days(best, one.data_from, one.data_until) < oldest_days:
            return best.epoch
    return None


def _age_days(row: OrbitRow, begin: datetime, end: datetime) -> float:
    """Return the largest distance between the data and what the orbit is of, days."""
    if row.until is not None and row.epoch <= end and row.until >= begin:
        return 0.0
    return max(abs(begin - row.epoch), abs(end - row.epoch)) / timedelta(days=1)

"""What a session will be calibrated with, found in the way of the calibration itself and before it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.indices.repository import FIELD_FILE, IndexRepository, sources_of
from app.jobs.kinds.calibration import CANDIDATES, CalibrationKind, limit_days
from app.jobs.kinds.contract import Admission
from app.jobs.preview_schemas import LeftOutSamples, PreviewColumn, PreviewOrbit, PreviewProblem, SessionPreview
from app.jobs.schemas import CalibrationBody
from app.orbits.nearest import chosen
from app.orbits.objects import difference
from app.orbits.parsing import orbit_of
from app.orbits.repository import OrbitRepository
from app.orbits.tables import OrbitRow
from app.parameter_sets.repository import ParameterSetRepository
from app.records.calibration_options import as_options
from app.satellites.repository import SatelliteRepository
from app.satellites.tables import Satellite
from app.sessions.repository import SessionRepository, samples_of
from app.sessions.tables import TelemetrySession
from app.storage.store import Store
from magcal_core.errors import MagcalError
from magcal_core.field.models import FieldName
from magcal_core.field.sources import FieldSources
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced, in_time_order
from magcal_core.reference.rows_asked_for import rows_asked_for, warnings_of_rows
from magcal_core.samples import EXCLUDED, SampleFlag, Samples

OF_THE_JOB: Final = frozenset({"calibrate", "priority"})
"""What a policy says beside the options of its calibrations."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What a preview is made of; ``problem``: what the job would be refused for."""

    row: TelemetrySession
    satellite: Satellite
    options_from: str
    admission: Admission
    near: Sequence[OrbitRow]
    in_force: str | None
    columns: Sequence[bytes]
    sources: FieldSources
    problem: MagcalError | None


def subject_of(session: Session, store: Store, caller: Caller, session_id: str, asked: dict[str, object]) -> Subject:
    """Return what a calibration of one session with the options ``asked`` would load.

    Raises
    ------
    MagcalError
        The caller reaches no such session, an option is wrong, or there is no telemetry.
    """
    row = SessionRepository(session, caller).get(session_id)
    options_from, options = _options(session, row, asked)
    body = {"kind": "calibration", "session_ids": [session_id], **options}
    kind = CalibrationKind()
    admission = kind.admit(session, caller, CalibrationBody.model_validate_json(json.dumps(body)))
    problem = None
    try:
        kind.check(session, admission)
    except MagcalError as error:
        problem = error
    begin, end = row.data_from or row.created_at, row.data_until or row.created_at
    orbits = OrbitRepository(session, SYSTEM, row.satellite_id)
    files, file_id = IndexRepository(session, SYSTEM), admission.request.get(FIELD_FILE)
    file = None if file_id is None or problem is not None else files.field_file_content(str(file_id))
    in_force = ParameterSetRepository(session, SYSTEM).in_force(row.satellite_id, row.magnetometer_id)
    return Subject(
        row=row,
        satellite=SatelliteRepository(session, SYSTEM).get(row.satellite_id),
        options_from=options_from,
        admission=admission,
        near=orbits.around(begin, end, limit_days(admission.request)),
        in_force=None if in_force is None or in_force.data_from >= begin else in_force.id,
        columns=SessionRepository(session, SYSTEM).columns(session_id, store),
        sources=sources_of(files.intervals_near(begin, end), file),
        problem=problem,
    )


def _options(session: Session, row: TelemetrySession, asked: dict[str, object]) -> tuple[str, Mapping[str, object]]:
    """Return where the options come from, and those: of the request, the policy, the set in force, or none."""
    if asked:
        return "request", asked
    sensor = SatelliteRepository(session, SYSTEM).magnetometer(row.satellite_id, row.magnetometer_id)
    policy = {name: value for name, value in (sensor.policy or {}).items() if name not in OF_THE_JOB}
    if policy:
        return "policy", policy
    in_force = ParameterSetRepository(session, SYSTEM).in_force(row.satellite_id, row.magnetometer_id)
    return ("defaults", {}) if in_force is None else ("set_in_force", {"method": in_force.method})


def preview(subject: Subject) -> SessionPreview:
    """Return what the calibration will have: orbits, field, columns and samples, and what would make it fail."""
    request = subject.admission.request
    options = CalibrationOptions.from_dict(
        {name: value for name, value in as_options(request).items() if name not in {FIELD_FILE, CANDIDATES}}
    )
    problems = [] if subject.problem is None else [subject.problem]
    sent, referenced = samples_of(subject.columns), None
    samples, outside = sent, 0
    warnings: list[str] = []
    try:
        samples = rows_asked_for(sent, options)
        outside = len(sent) - len(samples)
        warnings += warnings_of_rows(sent, samples, options)
        referenced = Referenced.of(samples, [orbit_of(one.content) for one in subject.near], options, subject.sources)
        samples = referenced.samples
        usable = _usable(referenced, options)
        warnings += referenced.report.warnings
    except MagcalError as error:
        problems = problems or [error]
        samples = _ordered(samples, options)
        usable = samples.is_used
    parts = FieldName.parse(options.field if referenced is None else referenced.report.field_model)
    return SessionPreview(
        session_id=subject.row.id,
        satellite=subject.row.satellite_id,
        magnetometer=subject.row.magnetometer_id,
        options_from=subject.options_from,
        options=dict(request),
        field_model=None if referenced is None else referenced.report.field_model,
        index_needed=None if parts is None else parts.needs,
        orbit_model=None if referenced is None else referenced.report.orbit_model,
        orbits=_orbits(subject, referenced),
        regressors=_columns(samples),
        samples=len(samples) + outside,
        usable=int(usable.sum()),
        left_out=_left_out(samples, usable, outside),
        compared_with=subject.in_force,
        warnings=warnings,
        problems=[PreviewProblem(code=one.code, detail=str(one)) for one in problems],
    )


def _usable(referenced: Referenced, options: CalibrationOptions) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return which samples the fit will have, shape (n,); columns that ``auto`` may choose are not asked for."""
    from magcal_core.estimation.estimate import Prepared

    return Prepared.of(referenced, options).usable


def _ordered(samples: Samples, options: CalibrationOptions) -> Samples:
    """Return the samples with the rows flagged that cannot be readings, also where there are too many of them."""
    try:
        return in_time_order(samples, is_plain=options.is_plain)
    except MagcalError:
        return samples


def _orbits(subject: Subject, referenced: Referenced | None) -> list[PreviewOrbit]:
    """Return the orbits that give positions; where none does and one is needed, the nearest there is."""
    if referenced is not None:
        used = [(subject.near[int(str(one["index"]))], one) for one in referenced.report.orbits]
        return [_orbit(subject, row, float(str(one["age_days"])), int(str(one["samples"]))) for row, one in used]
    begin, end = subject.row.data_from, subject.row.data_until
    nearest = None if begin is None else chosen(subject.near, begin)
    if nearest is None or begin is None or end is None:
        return []
    reaches = nearest.until or nearest.epoch
    age_s = max((begin - reaches).total_seconds(), (nearest.epoch - end).total_seconds(), 0.0)
    return [_orbit(subject, nearest, age_s / 86400.0, 0)]


def _orbit(subject: Subject, row: OrbitRow, age_days: float, samples: int) -> PreviewOrbit:
    norad_id = row.details.get("norad_id")
    return PreviewOrbit(
        id=row.id, format=row.format, name=row.name, norad_id=None if norad_id is None else str(norad_id),
        epoch=row.epoch, until=row.until, age_days=age_days, samples=samples,
        other_object=difference(subject.satellite, row.details),
    )  # fmt: skip


def _columns(samples: Samples) -> list[PreviewColumn]:
    found = []
    for name, values in samples.housekeeping.items():
        known = np.asarray(values, np.float64)
        known = known[np.isfinite(known) & samples.is_used]
        is_constant = not len(known) or bool(known.min() == known.max())
        found.append(PreviewColumn(name=name, samples=len(known), is_constant=is_constant))
    return found


def _left_out(samples: Samples, usable: np.ndarray[Any, np.dtype[np.bool_]], outside: int) -> list[LeftOutSamples]:
    counts = {
        str(flag.name).lower(): int(np.count_nonzero(samples.flags & np.uint16(flag)))
        for flag in SampleFlag
        if flag & EXCLUDED
    }
    counts["without"] = outside
    counts["no_value"] = int(np.count_nonzero(samples.is_used & ~usable))
    ordered = sorted(counts.items(), key=lambda one: -one[1])
    return [LeftOutSamples(reason=reason, samples=count) for reason, count in ordered if count]

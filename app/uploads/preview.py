"""HTTP of a look at telemetry before it is sent: its first rows, what each column is taken for, what would be read.

Nothing is kept. It is how a person finds the column names, the unit and the form of the times of a magnetometer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Station, authenticate
from app.access.caller import SYSTEM, Caller
from app.http.concurrency import Places
from app.http.receiving import Upload, receive
from app.http.schemas import utc_text
from app.http.services import services_of
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TELEMETRY_BODY
from app.orbits.repository import OrbitRepository
from app.problems import problem_of
from app.satellites.repository import SatelliteRepository
from app.satellites.tables import Magnetometer
from app.sessions.parsed import instant
from app.sessions.sensor_reading import SensorReading, format_of
from app.settings import Settings
from app.storage.database import Database
from app.uploads.endpoints import UploadServices
from app.uploads.preview_schemas import ColumnLook, LookQuery, RowLook, SampleLook, TelemetryLook
from magcal_core.errors import InputError, UnitsError
from magcal_core.samples import Samples
from magcal_core.telemetry.column_roles import ColumnRoles, column_roles
from magcal_core.telemetry.compression import decompress
from magcal_core.telemetry.first_rows import ROWS, FirstRows, first_rows
from magcal_core.telemetry.iso_times import Spans
from magcal_core.telemetry.long_table import long_columns
from magcal_core.telemetry.time_forms import BOOT, PARTS, UTC, WORDS, TimeForm
from magcal_core.telemetry.time_guesses import forms_of, spans_of

router = APIRouter(route_class=StrictJsonRoute, tags=["sessions"])

PLACES: Final = Places("looks at telemetry")
MOST_FORMS: Final = 4


@dataclass(frozen=True, slots=True)
class _Table:
    """The beginning of what was sent, and what its columns are taken for; None where that cannot be told."""

    rows: FirstRows | None
    roles: ColumnRoles | None
    forms: list[str]


@router.post("/satellites/{satellite_id}/sessions/preview", openapi_extra=TELEMETRY_BODY)
async def preview_upload(
    satellite_id: str, query: Annotated[LookQuery, Query()], request: Request, caller: Station
) -> TelemetryLook:
    """Show how telemetry would be read, and keep nothing: first rows, columns, unit, form of the times, faults."""
    held = services_of(request.app, UploadServices)
    magnetometer, spans = await run_in_threadpool(_place, satellite_id, query.magnetometer, caller, held.database)
    async with held.admission.place(caller):
        upload = await receive(request, held.settings, authenticate)
        return await run_in_threadpool(_look, upload, query.reading(SensorReading.of(magnetometer)), spans, held)


def _place(satellite_id: str, magnetometer_id: str, caller: Caller, database: Database) -> tuple[Magnetometer, Spans]:
    with database.read() as session:
        magnetometer = SatelliteRepository(session, caller).magnetometer(satellite_id, magnetometer_id)
        return magnetometer, spans_of(OrbitRepository(session, SYSTEM, satellite_id).instants())


def _look(upload: Upload, sensor: SensorReading, spans: Spans, held: UploadServices) -> TelemetryLook:
    with PLACES.one():
        table = _begun(upload, sensor, spans, held.settings)
        samples, problem = _read(upload, sensor, spans, held.settings)
    roles = table.roles
    return TelemetryLook(
        format=None if table.rows is None else table.rows.format,
        columns=_columns(table),
        rows=[] if table.rows is None else [RowLook(cells=list(row)) for row in table.rows.rows],
        reading=sensor.to_dict(),
        missing=[] if roles is None else list(roles.missing),
        suggested_columns={} if roles is None else dict(roles.suggested),
        suggested_unit=problem.looks_like if isinstance(problem, UnitsError) else None,
        suggested_time_formats=table.forms,
        time_formats={name: WORDS[name] for name in WORDS if name not in PARTS or name == "doy"},
        read=None if samples is None else _summary(samples),
        problem=None if problem is None else dict(problem_of(problem)),
    )


def _begun(upload: Upload, sensor: SensorReading, spans: Spans, settings: Settings) -> _Table:
    """Return the beginning of the table as it stands; what is wrong with it, reading it tells."""
    try:
        body = decompress(upload.content, max_bytes=settings.max_decompressed_mb << 20)
        rows = first_rows(body, format_of(upload.media_type))
    except InputError:
        return _Table(None, None, [])
    if long_columns(rows.header, sensor.columns) is not None:
        return _Table(rows, None, [])
    try:
        # A form that asks for an epoch is looked at without one: which column is what does not hang on it.
        named = None if sensor.time_format == BOOT else sensor.time_format
        roles = column_roles(rows.header, sensor.columns, TimeForm.of(named))
    except InputError:
        return _Table(rows, None, [])
    return _Table(rows, roles, _forms(rows, roles, spans))


def _forms(rows: FirstRows, roles: ColumnRoles, spans: Spans) -> list[str]:
    """Return the forms of time that suit the first row, in the column of the times or in what may be it."""
    near = [roles.suggested[name] for name in ("date", "time") if name in roles.suggested]
    own = near or sorted(roles.times, key=rows.header.index)
    if not own or not rows.rows:
        return []
    cells = [rows.rows[0][rows.header.index(name)] for name in own]
    found = forms_of(" ".join(cells), spans)
    # A date and a time of day in two columns, both of ISO 8601, need no further word.
    return [name for name in found if name != UTC or len(own) == 1][:MOST_FORMS]


def _columns(table: _Table) -> list[ColumnLook]:
    if table.rows is None:
        return []
    taken = {} if table.roles is None else table.roles.taken
    meant = {} if table.roles is None else {own: name for name, own in table.roles.suggested.items()}
    return [ColumnLook(name=own, taken_for=taken.get(own), may_be=meant.get(own)) for own in table.rows.header]


def _read(
    upload: Upload, sensor: SensorReading, spans: Spans, settings: Settings
) -> tuple[Samples | None, InputError | None]:
    try:
        return sensor.read(upload.content, upload.media_type, settings, spans).samples, None
    except InputError as error:
        return None, error


def _summary(samples: Samples) -> SampleLook:
    used = samples.h_nt[samples.is_used]
    first = samples.take(np.arange(min(ROWS, len(samples))))
    return SampleLook(
        samples=len(samples),
        used=len(used),
        data_from=utc_text(instant(samples.t_utc[0])),
        data_until=utc_text(instant(samples.t_utc[-1])),
        b_median_nt=float(np.median(np.linalg.norm(used, axis=1))) if len(used) else None,
        housekeeping=list(samples.housekeeping),
        first_times=[utc_text(instant(t_utc)) for t_utc in first.t_utc],
        first_nt=[[float(value) if np.isfinite(value) else None for value in row] for row in first.h_nt],
    )

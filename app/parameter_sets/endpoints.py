"""HTTP of parameter sets."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Operator, Reader, authenticate
from app.access.caller import Caller
from app.errors import NotFoundError, StoredObjectCorruptError
from app.http.dependencies import Blobs, Config, Db
from app.http.entity_tags import UNCHANGED, is_known, tagged_json, unchanged
from app.http.receiving import Upload, receive
from app.http.schemas import Name, Page
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.http.tables import TABLES, TELEMETRY_BODY, WRITTEN_TYPES, table_response, wanted_format, write_table
from app.parameter_sets.correction import Correction
from app.parameter_sets.cure_subject import subject_of
from app.parameter_sets.json_listing import ListingServices, found, listed, part, summaries
from app.parameter_sets.reasons import explained
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import (
    ActivateBody,
    ApplyQuery,
    ParameterSetQuery,
    ParameterSetRead,
    ParameterSetSummary,
    ReasonList,
    ReasonRead,
    TableQuery,
)
from app.parameter_sets.tables import ParameterSet
from app.records.arrow import from_bytes
from app.satellites.tables import Magnetometer
from app.sessions.sensor_reading import PLAIN, SensorReading, in_axes_of
from app.settings import Settings
from app.storage.store import residuals_key
from magcal_core.samples import Samples
from magcal_core.telemetry import write_samples

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])


@router.get("", response_model=Page[ParameterSetRead] | Page[ParameterSetSummary], responses=UNCHANGED)
def list_parameter_sets(
    query: Annotated[ParameterSetQuery, Query()], request: Request, caller: Reader, db: Db
) -> Response:
    """List the parameter sets, the newest first; with `at`, those in force at that time."""
    with db.engine.connect() as connection:
        wanted = listed(connection, caller, query)
        if is_known(request, wanted.tag):
            return unchanged(wanted.tag)
        if query.view == "summary":
            texts = summaries(connection, wanted)
        else:
            texts = services_of(request.app, ListingServices).texts.of(connection, wanted.sets)
    return tagged_json(part(texts, wanted), wanted.tag)


@router.get("/{parameter_set_id}", response_model=ParameterSetRead, responses=UNCHANGED)
def get_parameter_set(parameter_set_id: str, request: Request, caller: Reader, db: Db) -> Response:
    """Show a parameter set."""
    with db.engine.connect() as connection:
        wanted = found(connection, caller, parameter_set_id)
        if is_known(request, wanted.tag):
            return unchanged(wanted.tag)
        texts = services_of(request.app, ListingServices).texts.of(connection, wanted.sets)
    if not texts:  # removed with its satellite since it was found
        raise NotFoundError("no such parameter set")
    return tagged_json(texts[0], wanted.tag)


WHOLE: Final = {"x-whole-list": "The reasons of one verdict are a handful: all of them, the gravest first."}
"""Why a list has neither parts nor orders."""


@router.get("/{parameter_set_id}/reasons", openapi_extra=WHOLE)
def list_reasons(parameter_set_id: str, caller: Reader, db: Db) -> ReasonList:
    """Say in plain words why the verdict is what it is: each reason with figure, limit and what may mend it."""
    with db.read() as session:
        row = ParameterSetRepository(session, caller).get(parameter_set_id)
        subject = subject_of(session, caller, row)
    verdict = row.record["verdict"]
    if not isinstance(verdict, dict):
        raise StoredObjectCorruptError("the parameter set's record has no verdict")
    found = explained(verdict["reasons"], verdict.get("grades", []), subject)
    return ReasonList(items=[ReasonRead.model_validate(one) for one in found])


@router.get("/{parameter_set_id}/residuals", responses=TABLES)
def get_residuals(
    parameter_set_id: str,
    query: Annotated[TableQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
    store: Blobs,
) -> Response:
    """Give the residual of every sample as CSV, NDJSON, JSON columns or Parquet."""
    form = wanted_format(request, query.format, "json")
    with db.read() as session:
        row = ParameterSetRepository(session, caller).get(parameter_set_id)
        content = store.get(session, residuals_key(row.id), row.residuals_sha256)
    return table_response(write_table(from_bytes(content), form), form, f"residuals-{parameter_set_id}")


@router.post("/{parameter_set_id}/activate")
def activate_parameter_set(
    parameter_set_id: str,
    caller: Operator,
    db: Db,
    body: ActivateBody | None = None,
    force: Annotated[bool, Query(description="Also where the verdict is `refuse`.")] = False,
    reason: Annotated[Name | None, Query(description="Why; required where the verdict is `refuse`.")] = None,
) -> ParameterSetRead:
    """Put a parameter set in force for its magnetometer; the one before is retired."""
    is_forced = force or (body is not None and body.force)
    with db.write() as session:
        sets = ParameterSetRepository(session, caller)
        return sets.read(
            [sets.activate(parameter_set_id, force=is_forced, reason=reason or (None if body is None else body.reason))]
        )[0]


@router.post("/{parameter_set_id}/rollback")
def rollback_parameter_set(parameter_set_id: str, caller: Operator, db: Db) -> ParameterSetRead:
    """Undo an activation: the parameter set that was in force before is so again."""
    with db.write() as session:
        sets = ParameterSetRepository(session, caller)
        return sets.read([sets.rollback(parameter_set_id)])[0]


@router.post("/{parameter_set_id}/apply", openapi_extra=TELEMETRY_BODY, responses=TABLES)
async def apply_parameter_set(
    parameter_set_id: str,
    query: Annotated[ApplyQuery, Query()],
    request: Request,
    caller: Reader,
    db: Db,
    config: Config,
) -> Response:
    """Correct telemetry to nT in time order; `inverse=true` turns that back into raw readings in their own unit."""
    row, sensor = await run_in_threadpool(_row_and_sensor, parameter_set_id, caller, db)
    async with services_of(request.app, HttpServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        sent = WRITTEN_TYPES.get(upload.media_type.partition(";")[0].strip().lower(), "csv")
        form = wanted_format(request, query.format, sent)
        samples = await run_in_threadpool(_applied, row, sensor, upload, config, inverse=query.inverse)
        content = await run_in_threadpool(write_samples, samples, form)
    return table_response(content, form, "corrected")


def _row_and_sensor(parameter_set_id: str, caller: Caller, db: Db) -> tuple[ParameterSet, SensorReading]:
    with db.read() as session:
        row = ParameterSetRepository(session, caller).get(parameter_set_id)
        sensor = session.get_one(Magnetometer, (row.satellite_id, row.magnetometer_id))
        return row, in_axes_of(row.record, SensorReading.of(sensor))


def _applied(row: ParameterSet, sensor: SensorReading, upload: Upload, settings: Settings, *, inverse: bool) -> Samples:
    correction = Correction.of(row.record)
    if inverse:
        return sensor.unread(correction.unapply(PLAIN.read(upload.content, upload.media_type, settings).samples))
    return correction.apply(sensor.read(upload.content, upload.media_type, settings).samples)

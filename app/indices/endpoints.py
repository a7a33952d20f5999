"""HTTP of indices and files of coefficients, which serve all satellites."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from app.access.authentication import Reader, Station, authenticate
from app.access.caller import Caller
from app.http.dependencies import Config, Db
from app.http.paging import answered, page_of
from app.http.receiving import receive
from app.http.schemas import Page
from app.http.services import HttpServices, services_of
from app.http.strict_json import StrictJsonRoute
from app.indices.repository import IndexRepository, require_unbound
from app.indices.schemas import FieldFileQuery, FieldFileRead, FieldFileShort, FieldFileUpload, IndexQuery, IndexRead
from app.indices.tables import FieldFile, IndexFile
from app.storage.retry import retried
from magcal_core.field.coefficient_files import read_field_file
from magcal_core.field.index_files import read_index

router = APIRouter(route_class=StrictJsonRoute, tags=["indices"])

FILE: Final = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
INDEX_BODY: Final = {
    "requestBody": {
        "description": "An index file: Dst of Kyoto, Kp of GFZ, RC of DTU, CSV, or RC_index.h5.",
        "required": True,
        "content": FILE | {kind: {"schema": {"type": "string"}} for kind in ("text/plain", "text/csv")},
    }
}
FIELD_BODY: Final = {
    "requestBody": {
        "description": "Coefficients: .shc or .COF.",
        "required": True,
        "content": FILE | {"text/plain": {"schema": {"type": "string"}}},
    }
}


def _read(row: IndexFile) -> IndexRead:
    return IndexRead.model_validate({name: getattr(row, name) for name in IndexRead.model_fields})


def _read_file(row: FieldFile) -> FieldFileRead:
    own = {"id": row.id, "name": row.name, "sha256": row.sha256, "created_at": row.created_at}
    return FieldFileRead.model_validate(own | row.details)


@router.post(
    "/indices",
    status_code=201,
    openapi_extra=INDEX_BODY,
    responses={200: {"model": IndexRead, "description": "The same bytes were there already."}},
)
async def create_index(request: Request, response: Response, caller: Station, db: Db, config: Config) -> IndexRead:
    """Send an index file for all satellites; an hour has the value that came last."""
    require_unbound(caller)
    async with services_of(request.app, HttpServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        found, is_new = await run_in_threadpool(_keep_index, upload.content, caller, db)
    response.status_code = 201 if is_new else 200
    return found


def _keep_index(content: bytes, caller: Caller, db: Db) -> tuple[IndexRead, bool]:
    index = read_index(content)

    def add() -> tuple[IndexRead, bool]:
        with db.write() as session:
            row, is_new = IndexRepository(session, caller).add_index(content, index)
            return _read(row), is_new

    return retried(add)


@router.get("/indices", response_model=Page[IndexRead])
def list_indices(query: Annotated[IndexQuery, Query()], caller: Reader, db: Db) -> Response:
    """List the index files, the newest first."""
    with db.read() as session:
        found = IndexRepository(session, caller).page(query)
        return answered(page_of([_read(row) for row in found.rows], found, query, IndexRead))


@router.get("/indices/{index_id}")
def get_index(index_id: str, caller: Reader, db: Db) -> IndexRead:
    """Show an index file."""
    with db.read() as session:
        return _read(IndexRepository(session, caller).index(index_id))


@router.post(
    "/field-files",
    status_code=201,
    openapi_extra=FIELD_BODY,
    responses={200: {"model": FieldFileRead, "description": "The same bytes were there already."}},
)
async def create_field_file(
    query: Annotated[FieldFileUpload, Query()],
    request: Request,
    response: Response,
    caller: Station,
    db: Db,
    config: Config,
) -> FieldFileRead:
    """Send a file of coefficients for all satellites; jobs name it by its id."""
    require_unbound(caller)
    async with services_of(request.app, HttpServices).admission.place(caller):
        upload = await receive(request, config, authenticate)
        found, is_new = await run_in_threadpool(_keep_file, upload.content, query.name, caller, db)
    response.status_code = 201 if is_new else 200
    return found


def _keep_file(content: bytes, name: str | None, caller: Caller, db: Db) -> tuple[FieldFileRead, bool]:
    file = read_field_file(content, name)

    def add() -> tuple[FieldFileRead, bool]:
        with db.write() as session:
            row, is_new = IndexRepository(session, caller).add_field_file(content, file)
            return _read_file(row), is_new

    return retried(add)


@router.get("/field-files", response_model=Page[FieldFileRead] | Page[FieldFileShort])
def list_field_files(query: Annotated[FieldFileQuery, Query()], caller: Reader, db: Db) -> Response:
    """List the files of coefficients, the newest first."""
    with db.read() as session:
        found = IndexRepository(session, caller).page_of_field_files(query)
        return answered(page_of([_read_file(row) for row in found.rows], found, query, FieldFileShort))


@router.get("/field-files/{file_id}")
def get_field_file(file_id: str, caller: Reader, db: Db) -> FieldFileRead:
    """Show a file of coefficients."""
    with db.read() as session:
        return _read_file(IndexRepository(session, caller).field_file(file_id))

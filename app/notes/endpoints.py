"""HTTP of notes: the same two calls beside a satellite, a magnetometer, a session and a parameter set."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query, Response
from sqlalchemy.orm import Session

from app.access.authentication import Operator, Reader
from app.access.caller import Caller
from app.http.dependencies import Db
from app.http.paging import answered
from app.http.schemas import Page
from app.http.strict_json import StrictJsonRoute
from app.notes.repository import NoteRepository
from app.notes.schemas import NoteCreate, NoteQuery, NoteRead, NoteShort
from app.parameter_sets.repository import ParameterSetRepository
from app.satellites.repository import SatelliteRepository
from app.sessions.repository import SessionRepository

router = APIRouter(route_class=StrictJsonRoute, tags=["notes"])

SATELLITE = "/satellites/{satellite_id}/notes"
MAGNETOMETER = "/satellites/{satellite_id}/magnetometers/{magnetometer_id}/notes"
SESSION = "/sessions/{session_id}/notes"
PARAMETER_SET = "/parameter-sets/{parameter_set_id}/notes"
NOTES: Final = Page[NoteRead] | Page[NoteShort]
Asked = Annotated[NoteQuery, Query()]


def _of_satellite(session: Session, caller: Caller, satellite_id: str) -> NoteRepository:
    found = SatelliteRepository(session, caller).get(satellite_id)
    return NoteRepository(session, caller, "satellite", found.id, found.id)


def _of_magnetometer(session: Session, caller: Caller, satellite_id: str, magnetometer_id: str) -> NoteRepository:
    found = SatelliteRepository(session, caller).magnetometer(satellite_id, magnetometer_id)
    return NoteRepository(session, caller, "magnetometer", f"{found.satellite_id}/{found.id}", found.satellite_id)


def _of_session(session: Session, caller: Caller, session_id: str) -> NoteRepository:
    found = SessionRepository(session, caller).get(session_id)
    return NoteRepository(session, caller, "session", found.id, found.satellite_id)


def _of_parameter_set(session: Session, caller: Caller, parameter_set_id: str) -> NoteRepository:
    found = ParameterSetRepository(session, caller).get(parameter_set_id)
    return NoteRepository(session, caller, "parameter_set", found.id, found.satellite_id)


def _page(notes: NoteRepository, query: NoteQuery) -> Response:
    return answered(notes.page(query))


@router.get(SATELLITE, response_model=NOTES)
def list_satellite_notes(satellite_id: str, query: Asked, caller: Reader, db: Db) -> Response:
    """List the notes beside a satellite, the newest first."""
    with db.read() as session:
        return _page(_of_satellite(session, caller, satellite_id), query)


@router.post(SATELLITE, status_code=201)
def add_satellite_note(satellite_id: str, body: NoteCreate, caller: Operator, db: Db) -> NoteRead:
    """Write a note beside a satellite."""
    with db.write() as session:
        return _of_satellite(session, caller, satellite_id).add(body.text)


@router.get(MAGNETOMETER, response_model=NOTES)
def list_magnetometer_notes(satellite_id: str, magnetometer_id: str, query: Asked, caller: Reader, db: Db) -> Response:
    """List the notes beside a magnetometer, the newest first."""
    with db.read() as session:
        return _page(_of_magnetometer(session, caller, satellite_id, magnetometer_id), query)


@router.post(MAGNETOMETER, status_code=201)
def add_magnetometer_note(
    satellite_id: str, magnetometer_id: str, body: NoteCreate, caller: Operator, db: Db
) -> NoteRead:
    """Write a note beside a magnetometer."""
    with db.write() as session:
        return _of_magnetometer(session, caller, satellite_id, magnetometer_id).add(body.text)


@router.get(SESSION, response_model=NOTES)
def list_session_notes(session_id: str, query: Asked, caller: Reader, db: Db) -> Response:
    """List the notes beside a session, the newest first."""
    with db.read() as session:
        return _page(_of_session(session, caller, session_id), query)


@router.post(SESSION, status_code=201)
def add_session_note(session_id: str, body: NoteCreate, caller: Operator, db: Db) -> NoteRead:
    """Write a note beside a session."""
    with db.write() as session:
        return _of_session(session, caller, session_id).add(body.text)


@router.get(PARAMETER_SET, response_model=NOTES)
def list_parameter_set_notes(parameter_set_id: str, query: Asked, caller: Reader, db: Db) -> Response:
    """List the notes beside a parameter set, the newest first."""
    with db.read() as session:
        return _page(_of_parameter_set(session, caller, parameter_set_id), query)


@router.post(PARAMETER_SET, status_code=201)
def add_parameter_set_note(parameter_set_id: str, body: NoteCreate, caller: Operator, db: Db) -> NoteRead:
    """Write a note beside a parameter set."""
    with db.write() as session:
        return _of_parameter_set(session, caller, parameter_set_id).add(body.text)

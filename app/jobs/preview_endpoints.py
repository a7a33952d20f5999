"""HTTP of what a session will be calibrated with."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Query

from app.access.authentication import Reader
from app.http.concurrency import Places
from app.http.dependencies import Blobs, Db
from app.http.strict_json import StrictJsonRoute
from app.jobs.preview import preview, subject_of
from app.jobs.preview_schemas import PreviewQuery, SessionPreview

router = APIRouter(route_class=StrictJsonRoute, tags=["jobs"])

PLACES: Final = Places("previews")


@router.get("/sessions/{session_id}/preview")
def preview_calibration(
    session_id: str, query: Annotated[PreviewQuery, Query()], caller: Reader, db: Db, store: Blobs
) -> SessionPreview:
    """Show what a session will be calibrated with, before it is: orbit and its age, field, columns, usable samples."""
    with db.read() as session:
        subject = subject_of(session, store, caller, session_id, query.asked())
    with PLACES.one():
        return preview(subject)

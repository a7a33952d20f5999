"""HTTP of the reference field."""

from __future__ import annotations

import numpy as np
from fastapi import APIRouter

from app.access.authentication import Reader
from app.field.schemas import FieldRead, FieldRequest
from app.http.dependencies import Db
from app.http.schemas import core_times
from app.http.strict_json import StrictJsonRoute
from app.indices.repository import IndexRepository, sources_of, span_of
from magcal_core.field.models import FieldName, field_model
from magcal_core.orbit.earth.frames import convert_position

router = APIRouter(route_class=StrictJsonRoute, tags=["field"])


@router.post("/field")
def compute_field(body: FieldRequest, caller: Reader, db: Db) -> FieldRead:
    """Compute the reference field at given times and places, nT."""
    t_utc = core_times(body.time)
    r_km = np.array(body.position_km)
    r_itrf_km = r_km if body.frame == "ITRF" else convert_position(t_utc, r_km, body.frame, "ITRF")
    with db.read() as session:
        # Without an external field, and without a file, a model asks for nothing.
        parts = FieldName.parse(body.model)
        needs_index = parts is not None and parts.needs is not None
        files = IndexRepository(session, caller)
        intervals = files.intervals_near(*span_of(t_utc)) if needs_index else []
        file = None if body.field_file is None else files.field_file_content(body.field_file)
    model = field_model(body.model, body.max_degree, index_gap=body.index_gap, sources=sources_of(intervals, file))
    b_itrf_nt = model.field_itrf_nt(t_utc, r_itrf_km)
    b_nt = b_itrf_nt if body.frame == "ITRF" else convert_position(t_utc, b_itrf_nt, "ITRF", body.frame)
    return FieldRead(
        model=model.name,
        frame=body.frame,
        field_nt=b_nt.tolist(),
        magnitude_nt=np.linalg.norm(b_nt, axis=1).tolist(),
    )

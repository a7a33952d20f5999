"""HTTP of the reference field."""

from __future__ import annotations

import numpy as np
from fastapi import APIRouter

from app.access.authentication import Reader
from app.field.schemas import FieldRead, FieldRequest
from app.http.schemas import core_times
from app.http.strict_json import StrictJsonRoute
from magcal_core.field.models import field_model
from magcal_core.orbit.earth.frames import convert_position

router = APIRouter(route_class=StrictJsonRoute, tags=["field"])


@router.post("/field")
def compute_field(body: FieldRequest, _caller: Reader) -> FieldRead:
    """Compute the reference field at given times and places, nT."""
    t_utc = core_times(body.time)
    r_km = np.array(body.position_km)
    r_itrf_km = r_km if body.frame == "ITRF" else convert_position(t_utc, r_km, body.frame, "ITRF")
    model = field_model(body.model, body.max_degree)
    b_itrf_nt = model.field_itrf_nt(t_utc, r_itrf_km)
    b_nt = b_itrf_nt if body.frame == "ITRF" else convert_position(t_utc, b_itrf_nt, "ITRF", body.frame)
    return FieldRead(
        model=model.name,
        frame=body.frame,
        field_nt=b_nt.tolist(),
        magnitude_nt=np.linalg.norm(b_nt, axis=1).tolist(),
    )

"""A satellite is removed with all it has and nothing of another's: dry run first, by an admin, written down."""

from __future__ import annotations

import pytest
from sqlalchemy import select

from app.jobs.execution.leases import LostClaimError, claim_one, finish
from app.maintenance.audit import audit
from app.storage.database import Base
from app.storage.database_store import Blob, ObjectToRemove
from magcal_core.simulation.dekart_mission import tle_text

CSV = {"content-type": "text/csv"}
PASS = "time,bx,by,bz,ref_b\n2026-01-01T00:00:00Z,20000,1,2,20000\n"


@pytest.fixture
def service(shared):
    return shared


def fill(api, satellite: str) -> str:
    """Return a waiting job of a satellite with telemetry, an orbit and a magnetometer."""
    api.post("/satellites", json={"id": satellite}).raise_for_status()
    api.post(f"/satellites/{satellite}/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    headers = CSV | {"idempotency-key": f"{satellite}-1"}
    sent = api.post(f"/satellites/{satellite}/sessions?magnetometer=m", content=PASS, headers=headers)
    body = {"kind": "calibration", "session_ids": [sent.json()["id"]]}
    return api.post("/jobs", json=body, headers={"idempotency-key": f"{satellite}-2"}).json()["id"]


def left(service, satellite: str) -> dict[str, list[str]]:
    """Return the rows of every table in which the satellite's name stands anywhere."""
    with service.database.read() as session:
        rows = {
            table.name: [str(dict(row)) for row in session.execute(select(table)).mappings()]
            for table in Base.metadata.sorted_tables
        }
    return {name: found for name, them in rows.items() if (found := [row for row in them if f"'{satellite}'" in row])}


def test_it_takes_a_look_first_and_leaves_nothing_but_the_trail(service):
    with service.client() as api:
        job_id = fill(api, "gone")
        fill(api, "kept")
        job = api.post("/reprocessings", json={"satellites": ["gone", "kept"]}).json()["id"]
        seen = api.delete("/satellites/gone").json()
        counts = {name: seen[name] for name in ("magnetometers", "sessions", "orbits", "jobs", "unended_jobs")}
        assert counts == {"magnetometers": 1, "sessions": 1, "orbits": 2, "jobs": 2, "unended_jobs": 2}
        assert seen["is_removed"] is False
        assert api.get("/satellites/gone").status_code == 200
        with service.database.write() as session:
            claim = claim_one(session, job_id, "worker", 60.0, 3)
        assert api.delete("/satellites/gone", params={"confirm": "0" * 16}).status_code == 409
        done = api.delete("/satellites/gone", params={"confirm": seen["confirm"]})
        assert done.json()["is_removed"] is True
        assert api.get("/satellites/gone").status_code == 404
        assert api.get(f"/jobs/{job_id}").status_code == 404
        with pytest.raises(LostClaimError), service.database.write() as session:
            finish(session, claim, "succeeded", result={})
        assert set(left(service, "gone")) == {"audit_event"}
        assert "satellite.remove" in " ".join(left(service, "gone")["audit_event"])
        assert len(api.get("/satellites/kept/sessions").json()["items"]) == 1
        assert api.get(f"/jobs/{job}").json()["state"] == "running"
    with service.database.read() as session:
        assert [key for key in session.scalars(select(Blob.key)) if "gone" in key] == []
        assert session.scalars(select(ObjectToRemove)).all() == []
    assert audit(service.database, service.services.store).findings == ()


def test_only_an_admin_removes_and_only_what_was_seen(service):
    with service.client() as api, service.client(service.key("operate")) as operator:
        fill(api, "one")
        assert operator.delete("/satellites/one").status_code == 403
        seen = api.delete("/satellites/one").json()
        more = api.post("/satellites/one/sessions?magnetometer=m", content=PASS.replace("20000", "20001"), headers=CSV)
        assert more.status_code == 201
        answer = api.delete("/satellites/one", params={"confirm": seen["confirm"]})
        assert (answer.status_code, answer.json()["code"]) == (409, "conflict")
        assert len(api.get("/satellites/one/sessions").json()["items"]) == 2

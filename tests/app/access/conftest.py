"""A world of two satellites, and every call of the service as its OpenAPI document has it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

import httpx2
import pytest

from app.access.key_repository import KeyRepository
from app.attention.entries import entry_id
from app.storage.database import utc_now
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples

ABSENT = "0" * 32
CSV = {"content-type": "text/csv"}
JSON = {"content-type": "application/json"}
TLE = {"content-type": "text/plain"}
INDEX = b"hour,dst_nt\n1999-05-11T00:00:00Z,-10\n"
"""Hours before all telemetry of these tests."""
FIELD_FILE = Path(__file__).resolve().parents[2] / "data" / "field" / "core.shc"
FIGURES = {"parameter_set_id": "before-after", "session_id": "raw", "satellite_id": "history"}


@dataclass(frozen=True)
class Operation:
    """One call of the document."""

    method: str
    path: str
    scopes: tuple[str, ...]
    document: dict[str, object] = field(repr=False, compare=False)

    @property
    def name(self) -> str:
        """The call as one line."""
        return f"{self.method} {self.path}"

    @property
    def parameters(self) -> list[str]:
        """The names in the path."""
        return re.findall(r"{(\w+)}", self.path)


@dataclass(frozen=True)
class World:
    """What stands for every kind of thing, of one satellite."""

    satellite: str
    ids: dict[str, str]
    telemetry: bytes

    def url(self, operation: Operation) -> str:
        """Return the address of the call for this world's things."""
        figure = FIGURES.get(operation.parameters[0]) if "figure" in operation.parameters else None
        return operation.path.removeprefix("/api/v1").format(**self.ids, figure=figure)

    def request(self, operation: Operation) -> dict[str, object]:
        """Return a sound body and query of the call, so far as it needs them."""
        name = operation.name.replace("/api/v1", "")
        telemetry = {"content": self.telemetry, "headers": CSV}
        ids = self.ids
        return {
            "POST /satellites": {"json": {"id": f"{self.satellite}-b"}},
            "POST /satellites/{satellite_id}/magnetometers": {"json": {"id": "second", "unit": "nT"}},
            "POST /satellites/{satellite_id}/orbits": {"content": tle_text().encode(), "headers": TLE},
            "POST /satellites/{satellite_id}/sessions": telemetry | {"params": {"magnetometer": "mgm"}},
            "POST /satellites/{satellite_id}/sessions/confirm": {"json": {"magnetometer": "mgm", "sha256": ["0" * 64]}},
            "POST /satellites/{satellite_id}/sessions/preview": telemetry | {"params": {"magnetometer": "mgm"}},
            "POST /sessions/{session_id}/samples": telemetry,
            "POST /parameter-sets/{parameter_set_id}/apply": telemetry,
            "POST /jobs": {"json": {"kind": "calibration", "session_ids": [ids["session_id"]]}},
            "PATCH /satellites/{satellite_id}": {"json": {"name": "another"}},
            "PATCH /satellites/{satellite_id}/magnetometers/{magnetometer_id}": {"json": {"noise_nt": 50.0}},
            "POST /reprocessings": {"json": {"satellites": [self.satellite]}},
            "POST /field": {"json": {"time": ["2026-01-01T00:00:00Z"], "position_km": [[7000.0, 0.0, 0.0]]}},
            "POST /keys": {"json": {"scopes": ["read"]}},
            "POST /parameter-sets/{parameter_set_id}/aboard": {"json": {"state": "uploaded"}},
            "POST /attention/{entry_id}/acknowledge": {"json": {"note": "seen"}},
            "POST /satellites/{satellite_id}/notes": {"json": {"text": "a note"}},
            "POST /satellites/{satellite_id}/magnetometers/{magnetometer_id}/notes": {"json": {"text": "a note"}},
            "POST /sessions/{session_id}/notes": {"json": {"text": "a note"}},
            "POST /parameter-sets/{parameter_set_id}/notes": {"json": {"text": "a note"}},
            "POST /webhooks": {"json": {"url": "http://127.0.0.1:9/", "events": ["attention.raised"]}},
            "POST /sessions/{session_id}/which-object": {"content": tle_text().encode(), "headers": TLE},
            "POST /indices": {"content": INDEX, "headers": CSV},
            "POST /field-files": {"content": FIELD_FILE.read_bytes(), "headers": TLE},
            "GET /sessions/{session_id}/residual": {"params": {"parameter_set": ids["parameter_set_id"]}},
            "GET /sessions/{session_id}/comparison": {"params": {"other": ids["session_id"]}},
            "GET /parameter-sets/{parameter_set_id}/comparison": {"params": {"other": ids["parameter_set_id"]}},
            "GET /figures/compare": {"params": {"first": ids["parameter_set_id"], "second": ids["parameter_set_id"]}},
        }.get(name, {})


def scopes_of(operation: dict[str, object]) -> tuple[str, ...]:
    """Return the scopes of which the call needs one."""
    security = operation.get("security", [])
    assert isinstance(security, list)
    return tuple(scope for way in security for scopes in way.values() for scope in scopes)


@pytest.fixture(scope="session")
def document(service) -> dict:
    answer = httpx2.get(f"{service.url}/openapi.json", trust_env=False, timeout=60.0)
    answer.raise_for_status()
    return answer.json()


@pytest.fixture(scope="session")
def operations(document) -> list[Operation]:
    """Every call of the document."""
    return [
        Operation(method.upper(), path, scopes_of(operation), operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
    ]


@pytest.fixture(scope="session")
def guarded(operations) -> list[Operation]:
    """Every call that needs a key."""
    return [operation for operation in operations if operation.path.startswith("/api/")]


@pytest.fixture(scope="session")
def world(service, names) -> World:
    """A satellite with one of everything: magnetometer, orbit, session, job, parameter set, key; an index, a file."""
    with service.client() as admin:
        return build_world(admin, next(names))


def build_world(admin: httpx2.Client, name: str) -> World:
    telemetry = write_samples(simulated(SESSIONS[0], 120).samples, "csv")
    admin.post("/satellites", json={"id": name}).raise_for_status()
    admin.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    orbits = admin.post(f"/satellites/{name}/orbits", content=tle_text().encode(), headers=TLE)
    sent = admin.post(
        f"/satellites/{name}/sessions", params={"magnetometer": "mgm"}, content=telemetry, headers=CSV
    ).raise_for_status()
    wanted = {"kind": "calibration", "session_ids": [sent.json()["id"]], "method": "scalar"}
    job = ended(admin, admin.post("/jobs", json=wanted).raise_for_status().json()["id"])
    assert job["state"] == "succeeded", job["error"]
    key = admin.post("/keys", json={"scopes": ["read"], "satellites": [name]}).raise_for_status().json()
    index = admin.post("/indices", content=INDEX, headers=CSV).raise_for_status()
    field_file = admin.post("/field-files", content=FIELD_FILE.read_bytes(), headers=TLE).raise_for_status()
    hook = admin.post("/webhooks", json={"url": "http://127.0.0.1:9/", "events": ["attention.raised"]})
    ids = {
        "webhook_id": hook.raise_for_status().json()["id"],
        "delivery_id": ABSENT,
        "entry_id": entry_id(name, "mgm", "data_stale"),
        "satellite_id": name,
        "magnetometer_id": "mgm",
        "orbit_id": orbits.json()["items"][0]["id"],
        "session_id": sent.json()["id"],
        "job_id": job["id"],
        "parameter_set_id": job["result"]["parameter_set_id"],
        "key_id": key["id"],
        "index_id": index.json()["id"],
        "file_id": field_file.json()["id"],
    }
    return World(name, ids, telemetry)


def ended(admin: httpx2.Client, job_id: str) -> dict:
    """Return the job once it has ended."""
    deadline = time.monotonic() + 90
    while (job := admin.get(f"/jobs/{job_id}").json())["state"] in {"queued", "running"}:
        assert time.monotonic() < deadline, job
        time.sleep(0.05)
    return job


@pytest.fixture(scope="session")
def wrong_keys(service) -> dict[str, str]:
    """A key of each kind that must not work: kind -> Authorization header."""
    with service.database.write() as session:
        keys = KeyRepository(session)
        expired = keys.create(["admin"], expires_at=utc_now() - timedelta(seconds=1)).key
        revoked = keys.create(["admin"])
        keys.revoke(revoked.row.id)
        good = keys.create(["admin"]).key
    head, key_id, secret = good.split("_", 2)
    return {
        "malformed": "Bearer not-a-key",
        "empty": "Bearer",
        "another scheme": "Basic YWRtaW46YWRtaW4=",
        "unknown": f"Bearer {head}_{'0' * 16}_{secret}",
        "wrong secret": f"Bearer {head}_{key_id}_{secret[:-1]}{'A' if secret[-1] != 'A' else 'B'}",
        "half a secret": f"Bearer {good[:-10]}",
        "expired": f"Bearer {expired}",
        "revoked": f"Bearer {revoked.key}",
        "not ASCII": f"Bearer {good}\u00e9",
        "very long": f"Bearer {good}{'A' * 30_000}",
    }


@pytest.fixture
def anonymous(service) -> Iterator[httpx2.Client]:
    """A client without a key."""
    with service.client("") as client:
        yield client

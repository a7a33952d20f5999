"""What is asked of a large fleet reads a small part of every large table, as PostgreSQL itself tells of its plans."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import httpx2
import psycopg
import pytest
from sqlalchemy import Connection, Engine, event

from app.access.caller import SYSTEM
from app.attention.lives import tell_lives
from app.jobs.tables import Job, JobSession
from app.maintenance.retention import expired
from app.parameter_sets.tables import Activation, ParameterSet, ParameterSetSession
from app.records.json_numbers import without_nan
from app.settings import Settings
from app.storage.database import new_id, utc_now
from benchmarks.planted import SEED, plant
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of, tle_text
from magcal_core.telemetry import write_samples

pytestmark = pytest.mark.postgres

SATELLITES: Final = 150
EACH: Final = 60
SETS: Final = 30
LARGE: Final = ("session", "chunk", "job", "job_session", "parameter_set", "parameter_set_session", "activation")
SHARE: Final = 0.1
"""Of a table's rows, that one scan may read: each magnetometer has its newest set looked up, one of thirty."""

FEW: Final = 1001
"""Rows that one list may read from an end of an index, without a condition on it."""

Statement = tuple[str, Any]
Plan = Mapping[str, Any]


@contextmanager
def noted(engine: Engine) -> Iterator[list[Statement]]:
    """Yield a list that gets every statement that ``engine`` is given to read with."""
    found: list[Statement] = []

    def note(_connection: Connection, _cursor: object, statement: str, values: Any, *_rest: object) -> None:
        if statement.lstrip().startswith(("SELECT", "WITH")):
            found.append((statement, values))

    event.listen(engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        event.remove(engine, "before_cursor_execute", note)


def nodes(plan: Plan) -> Iterator[Plan]:
    yield plan
    for below in plan.get("Plans", ()):
        yield from nodes(below)


def faults(connection: psycopg.Connection, statement: Statement, sizes: Mapping[str, int]) -> Iterator[str]:
    """Yield which scans of a statement read too much, with indexes used wherever one serves."""
    ((found,),) = connection.execute(f"EXPLAIN (ANALYZE, TIMING OFF, FORMAT JSON) {statement[0]}", statement[1])
    for node in nodes(found[0]["Plan"]):
        table = node.get("Relation Name")
        if table not in LARGE:
            continue
        left = node.get("Rows Removed by Filter", 0) + node.get("Rows Removed by Index Recheck", 0)
        read = (node["Actual Rows"] + left) * node["Actual Loops"]
        is_whole = "Scan" in node["Node Type"] and "Index Cond" not in node and "Recheck Cond" not in node
        if (is_whole and read > FEW) or read > SHARE * sizes[table]:
            yield f"{node['Node Type']} of {table} reads {read:.0f} of {sizes[table]} rows: {_conditions(node)}"


def _conditions(node: Plan) -> str:
    return " ".join(
        f"{name}: {str(node[name])[:200]}" for name in ("Index Name", "Index Cond", "Filter") if name in node
    )


def seed(service: Any) -> None:
    """Make one satellite with a session, and a parameter set of it that is in force."""
    telemetry = simulated(SESSIONS[0]).samples
    with service.client() as api:
        api.post("/satellites", json={"id": SEED}).raise_for_status()
        api.post(f"/satellites/{SEED}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        plain = {"Content-Type": "text/plain"}
        api.post(f"/satellites/{SEED}/orbits", content=tle_text(), headers=plain).raise_for_status()
        body = write_samples(telemetry, "csv")
        path = f"/satellites/{SEED}/sessions?magnetometer=mgm"
        session_id = api.post(path, content=body, headers={"Content-Type": "text/csv"}).raise_for_status().json()["id"]
    record = without_nan(calibrate(telemetry, [Sgp4Orbit(tle_of(SESSIONS[0]))], time_offset="none").to_dict())
    assert isinstance(record, dict)
    now, job_id, set_id, place = utc_now(), new_id(), new_id(), {"satellite_id": SEED, "magnetometer_id": "mgm"}
    with service.database.write() as session:
        session.add(
            Job(
                id=job_id, kind="calibration", state="succeeded", priority=0, rank=0, request={}, request_version=1,
                progress=1.0, attempts=1, lost_attempts=0, cancel_requested=False, result={}, created_at=now, **place,
            )
        )  # fmt: skip
        session.flush()
        session.add(JobSession(job_id=job_id, session_id=session_id))
        session.add(
            ParameterSet(
                id=set_id, job_id=job_id, status="active", grade="accept", method="scalar", data_from=now,
                data_until=now, record=record, residuals_sha256="0" * 64, created_at=now, **place,
            )
        )  # fmt: skip
        session.flush()
        session.add(ParameterSetSession(parameter_set_id=set_id, session_id=session_id))
        session.add(Activation(id=new_id(), parameter_set_id=set_id, begun_at=now, **place))
    tell_lives(service.database, service.services.fleet)


def test_nothing_that_is_asked_of_a_large_fleet_reads_a_large_table_whole(
    postgres_url: str, tmp_path: Path, serving: Callable[[Settings], Iterator[Any]]
) -> None:
    settings = Settings(data_dir=tmp_path, database_url=postgres_url, workers=0, min_free_mb=0)
    for service in serving(settings):
        seed(service)
        key = service.admin_key
    plain = postgres_url.replace("+psycopg", "")
    plant(plain, SATELLITES, EACH, SETS)  # indexes are dropped for it, which a service that runs would wait for
    for service in serving(settings):
        found: dict[str, Sequence[Statement]] = {}
        with service.client(key) as api:
            for name, ask in asked(service, api).items():
                with noted(service.database.engine) as statements:
                    ask()
                found[name] = list(statements)
        with psycopg.connect(plain, autocommit=True) as connection:
            connection.execute("UPDATE satellite SET retention_days = 3650")
        with noted(service.database.engine) as statements:
            assert expired(service.database) == []
        found["retention"] = list(statements)
        with psycopg.connect(plain, autocommit=True) as connection:
            # A fleet that a test can plant is small enough to be read whole at once; this one is looked up as a large
            # one is, so that what no index serves stands out.
            for other in ("enable_seqscan", "enable_hashjoin", "enable_mergejoin"):
                connection.execute(f"SET {other} = off".encode())
            sizes = {
                name: connection.execute(f"SELECT count(*) FROM {name}".encode()).fetchone()[0]  # type: ignore[index]  # noqa: S608
                for name in LARGE
            }
            assert min(sizes.values()) >= SATELLITES * SETS
            told = [
                f"{name}: {fault}"
                for name, statements in found.items()
                for statement in statements
                for fault in faults(connection, statement, sizes)
            ]
        assert all(found.values()), found
        assert not told, chr(10).join(told)


def asked(service: Any, api: httpx2.Client) -> dict[str, Callable[[], object]]:
    """What is asked of the service, by name."""
    at = datetime.now(UTC) - timedelta(days=3)
    some = "sat-000077"
    paths = {
        "the fleet, first": "/fleet",
        "attention": "/attention?limit=100&total=true",
        "overview": "/overview?limit=10",
        "overview of a satellite": f"/overview?satellite={some}",
        "history": f"/satellites/{some}/history?limit=50",
        "history of a magnetometer": f"/satellites/{some}/history?limit=50&magnetometer=mgm",
        "set in force at a time": f"/parameter-sets?satellite={some}&at={at:%Y-%m-%dT%H:%M:%SZ}",
        "sets in force of all at a time": f"/parameter-sets?view=summary&limit=50&at={at:%Y-%m-%dT%H:%M:%SZ}",
        "sets of a satellite": f"/parameter-sets?satellite={some}&limit=50",
        "sessions of a satellite": f"/sessions?satellite={some}&limit=50",
        "sessions of all": "/sessions?limit=50",
        "jobs": "/jobs?limit=50",
        "jobs that failed": "/jobs?state=failed&limit=50",
    }

    def get(path: str) -> Callable[[], object]:
        return lambda: api.get(path).raise_for_status()

    def renamed() -> None:
        api.patch(f"/satellites/{some}", json={"name": "Renamed"}).raise_for_status()
        api.get("/fleet").raise_for_status()

    def looked_at() -> None:
        with service.database.read() as session:
            service.services.fleet.view(session, SYSTEM)

    asking: dict[str, Callable[[], object]] = {name: get(path) for name, path in paths.items()}
    return asking | {
        "the fleet after a change": renamed,
        "what is known of the fleet": looked_at,
        "lives of sets": lambda: tell_lives(service.database, service.services.fleet),
    }

"""A fleet of any size in PostgreSQL, copied row by row from one satellite that the service made.

Rows lie as they would have arrived: pass after pass, of each the satellites in turn. Objects are not copied: a row that
names one names what is not there.
"""

from __future__ import annotations

from typing import Final

import psycopg
from psycopg import sql

SEED: Final = "seed"
"""Id of the satellite that is copied; it has one magnetometer, and one set in force or none."""
NAME: Final = "'sat-' || lpad(i::text, 6, '0')"
ID: Final = "lpad(to_hex({} * %(satellites)s::bigint + i + 1), 32, '0')"
SESSION: Final = ID.format("k")
SESSION_OF_SET: Final = ID.format("(((s + 1) * %(sessions)s) / %(sets)s - 1)")
SET: Final = ID.format("s")
TIME: Final = "date_trunc('hour', now()) - make_interval(hours => 6 * (%(sessions)s - ({}))::int, secs => i / 10)"
PASS: Final = TIME.format("k")
SET_TIME: Final = TIME.format("((s + 1) * %(sessions)s) / %(sets)s - 1")
NEXT_TIME: Final = TIME.format("((s + 2) * %(sessions)s) / %(sets)s - 1")
IS_LAST: Final = "s = %(sets)s - 1"
DIGEST: Final = "lpad(to_hex(k * %(satellites)s::bigint + i + 1), 64, '0')"
EACH: Final = "generate_series(0, %(satellites)s - 1) i"
PASSES: Final = f"generate_series(0, %(sessions)s - 1) k, {EACH}"
SETS: Final = f"generate_series(0, %(sets)s - 1) s, {EACH}"
PLANTED: Final = {
    "satellite": (EACH, {"id": NAME, "name": "'Satellite ' || i"}),
    "magnetometer": (EACH, {"satellite_id": NAME}),
    "orbit": (EACH, {"id": ID.format("0"), "satellite_id": NAME}),
    "session": (
        PASSES,
        {"id": SESSION, "satellite_id": NAME, "sha256": DIGEST, "data_from": PASS}
        | {"data_until": f"{PASS} + interval '90 min'", "created_at": f"{PASS} + interval '2 h'"},
    ),
    "chunk": (PASSES, {"session_id": SESSION, "sha256": DIGEST, "created_at": f"{PASS} + interval '2 h'"}),
    "job": (SETS, {"id": SET, "satellite_id": NAME}),
    "job_session": (SETS, {"job_id": SET, "session_id": SESSION_OF_SET}),
    "parameter_set": (
        SETS,
        {"id": SET, "job_id": SET, "satellite_id": NAME, "data_from": SET_TIME, "created_at": SET_TIME}
        | {"data_until": f"{SET_TIME} + interval '90 min'"}
        | {"status": f"CASE WHEN {IS_LAST} THEN 'active' ELSE 'retired' END"},
    ),
    "parameter_set_session": (SETS, {"parameter_set_id": SET, "session_id": SESSION_OF_SET}),
    "activation": (
        SETS,
        {"id": SET, "satellite_id": NAME, "parameter_set_id": SET, "begun_at": SET_TIME}
        | {"previous_id": f"CASE WHEN s > 0 THEN {ID.format('(s - 1)')} END"}
        | {"ended_at": f"CASE WHEN NOT {IS_LAST} THEN {NEXT_TIME} END"},
    ),
    "set_life": (
        f"{EACH}, (SELECT %(sets)s - 1 AS s) newest",
        {"satellite_id": NAME, "parameter_set_id": SET, "newest_set_id": SET},
    ),
}  # fmt: skip
"""Table -> what its rows are made for, and what differs from the row of the satellite that is copied."""
SEED_ROWS: Final = {
    "satellite": "id = %(seed)s",
    "job": "id IN (SELECT job_id FROM parameter_set WHERE satellite_id = %(seed)s)",
    "chunk": "session_id IN (SELECT id FROM session WHERE satellite_id = %(seed)s)",
    "job_session": "job_id IN (SELECT job_id FROM parameter_set WHERE satellite_id = %(seed)s)",
    "parameter_set_session": "parameter_set_id IN (SELECT id FROM parameter_set WHERE satellite_id = %(seed)s)",
}
"""Table -> which of its rows are copied, where that is not any of the satellite's."""


def plant(url: str, satellites: int, sessions: int, sets: int) -> None:
    """Plant ``satellites`` with ``sessions`` and parameter ``sets`` each, the newest in force, at most one a session.

    Foreign keys are not looked at, and indexes that no constraint needs are made anew once the rows are there.
    """
    values = {"seed": SEED, "satellites": satellites, "sessions": sessions, "sets": sets}
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("SET session_replication_role = replica")
        connection.execute("SET synchronous_commit = off")
        connection.execute("SET statement_timeout = 0")
        connection.execute("SET maintenance_work_mem = '1GB'")
        for table in PLANTED:
            _plant(connection, table, values)
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("VACUUM ANALYZE")


def _plant(connection: psycopg.Connection[tuple[object, ...]], table: str, values: dict[str, object]) -> None:
    made_for, own = PLANTED[table]
    names = connection.execute(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = 'public' AND table_name = %s", [table]
    ).fetchall()
    indexes = connection.execute(
        "SELECT indexname, indexdef FROM pg_indexes WHERE schemaname = 'public' AND tablename = %s AND NOT EXISTS ("
        "SELECT 1 FROM pg_constraint WHERE conindid = ('public.' || quote_ident(indexname))::regclass)", [table],
    ).fetchall()  # fmt: skip
    columns = [str(name) for (name,) in names]
    for name, _ in indexes:
        connection.execute(sql.SQL("DROP INDEX {}").format(sql.Identifier(str(name))))
    chosen = sql.SQL(", ").join(
        sql.SQL(own[name]) if name in own else sql.SQL("seed.{}").format(sql.Identifier(name)) for name in columns
    )
    connection.execute(
        sql.SQL("INSERT INTO {} ({}) SELECT {} FROM (SELECT * FROM {} WHERE {} LIMIT 1) seed, {}").format(
            sql.Identifier(table),
            sql.SQL(", ").join(map(sql.Identifier, columns)),
            chosen,
            sql.Identifier(table),
            sql.SQL(SEED_ROWS.get(table, "satellite_id = %(seed)s")),
            sql.SQL(made_for),
        ),
        values,
    )
    for _, definition in indexes:
        connection.execute(str(definition).encode())

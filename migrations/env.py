"""Alembic's entry: migrates the connection that magcal hands over."""

from __future__ import annotations

from typing import Literal

from alembic import context
from alembic.autogenerate.api import AutogenContext

import app.access.audit_trail
import app.access.idempotency
import app.access.key_tables
import app.jobs.tables
import app.orbits.tables
import app.parameter_sets.tables
import app.satellites.tables
import app.sessions.tables
import app.storage.database_store  # noqa: F401
from app.storage.database import Base, JsonColumn, UtcDateTime


def render_item(kind: str, item: object, autogen: AutogenContext) -> str | Literal[False]:
    """Return the column types of magcal under their own names."""
    if kind == "type" and isinstance(item, UtcDateTime):
        autogen.imports.add("from app.storage.database import UtcDateTime")
        return "UtcDateTime()"
    if kind == "type" and item is JsonColumn:
        autogen.imports.add("from app.storage.database import JsonColumn")
        return "JsonColumn"
    return False


connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    render_as_batch=True,
    render_item=render_item,
    compare_type=True,
    transaction_per_migration=False,
)
with context.begin_transaction():
    context.run_migrations()

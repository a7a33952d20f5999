"""`magcal keys`: create, list and revoke API keys, in the database itself."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

SCOPES = ("read", "ingest", "operate", "admin")


class NameList(click.ParamType[list[str]]):
    """Names with commas between them."""

    name = "A,B,.."

    def convert(self, value: str | list[str], param: click.Parameter | None, ctx: click.Context | None) -> list[str]:
        """Return the names."""
        names = [part.strip() for part in value.split(",")] if isinstance(value, str) else value
        if not all(names):
            self.fail("want names with commas between them", param, ctx)
        return names


class UtcMoment(click.ParamType[datetime]):
    """A time in ISO 8601 with a zone."""

    name = "T"

    def convert(self, value: str | datetime, param: click.Parameter | None, ctx: click.Context | None) -> datetime:
        """Return the time, in UTC."""
        from pydantic_core import PydanticCustomError

        from app.http.schemas import parse_utc

        try:
            time = parse_utc(value)
        except PydanticCustomError as error:
            self.fail(error.message(), param, ctx)
        if not isinstance(time, datetime):
            self.fail("want a time", param, ctx)
        return time


@contextmanager
def _writing() -> Iterator[Session]:
    from app.settings import Settings
    from app.storage.database import Database
    from app.storage.migration import upgrade

    settings = Settings()
    database = Database(settings)
    try:
        upgrade(database, settings)
        with database.write() as session:
            yield session
    finally:
        database.close()


@click.group("keys")
def command() -> None:
    """Create, list and revoke API keys."""


@command.command("create")
@click.option("--scopes", type=NameList(), required=True, help=f"What the key may do: {', '.join(SCOPES)}.")
@click.option("--satellites", type=NameList(), help="The satellites that it is bound to.  [default: all]")
@click.option("--expires", type=UtcMoment(), help="When it ends, ISO 8601 with a zone.  [default: never]")
@click.option("--name", help="What it is for.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def create(
    scopes: list[str], satellites: list[str] | None, expires: datetime | None, name: str | None, as_json: bool
) -> None:
    """Make a key and print it, this once."""
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown:
        raise click.BadParameter(f"unknown scope {unknown[0]}; known are {', '.join(SCOPES)}", param_hint="--scopes")
    from app.access.key_repository import KeyRepository
    from app.http.schemas import utc_text

    with _writing() as session:
        made = KeyRepository(session).create(scopes, satellites, expires, name)
    if as_json:
        expires_at = None if expires is None else utc_text(expires)
        record = {
            "id": made.row.id,
            "key": made.key,
            "scopes": made.row.scopes,
            "satellites": made.row.satellites,
            "expires_at": expires_at,
            "name": name,
        }
        click.echo(json.dumps(record))
    else:
        click.echo(made.key)


@command.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_keys(as_json: bool) -> None:
    """List the keys, the newest first, without their secrets."""
    from sqlalchemy import select

    from app.access.key_schemas import KeyRead
    from app.access.key_tables import ApiKey

    with _writing() as session:
        rows = session.scalars(select(ApiKey).order_by(ApiKey.created_at.desc(), ApiKey.id)).all()
        records = [KeyRead.model_validate(row).model_dump(mode="json") for row in rows]
    if as_json:
        click.echo(json.dumps(records))
        return
    for record in records:
        state = (
            "revoked" if record["revoked_at"] else f"until {record['expires_at']}" if record["expires_at"] else "valid"
        )
        where = "all satellites" if record["satellites"] is None else ",".join(record["satellites"])
        click.echo(f"{record['id']}  {','.join(record['scopes'])}  {where}  {state}  {record['name'] or ''}".rstrip())


@command.command("revoke")
@click.argument("key_id", metavar="ID")
def revoke(key_id: str) -> None:
    """Revoke a key: its next request is refused, in every process."""
    from app.access.key_repository import KeyRepository

    with _writing() as session:
        KeyRepository(session).revoke(key_id)
    click.echo(f"{key_id} revoked")

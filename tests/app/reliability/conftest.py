"""Services that the tests of a module share, over each kind of store."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import make_url

from app.settings import Settings


@pytest.fixture(scope="module")
def database_url(postgres_server: str, database_numbers: Iterator[int]) -> Iterator[str]:
    """An empty database of the server, for one module."""
    name = f"magcal_{next(database_numbers)}"
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}".encode())
    yield make_url(postgres_server).set(database=name).render_as_string(hide_password=False)
    with psycopg.connect(postgres_server, autocommit=True) as connection:
        connection.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())


@pytest.fixture(scope="module", params=["sqlite", "folder", pytest.param("postgres", marks=pytest.mark.postgres)])
def shared(
    request: pytest.FixtureRequest, serving: Callable[..., Iterator[object]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[object]:
    """A service without workers on SQLite, on SQLite with a folder for its objects, and on PostgreSQL."""
    folder: Path = tmp_path_factory.mktemp("shared")
    url = request.getfixturevalue("database_url") if request.param == "postgres" else None
    store_url = f"file://{folder}/objects" if request.param == "folder" else None
    yield from serving(
        Settings(data_dir=folder / "data", database_url=url, store_url=store_url, workers=0, min_free_mb=0)
    )

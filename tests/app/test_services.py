"""What the application holds is one typed value, which nobody goes round."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import FrozenInstanceError, fields, is_dataclass
from pathlib import Path

import pytest
from fastapi import FastAPI

import app
from app.access.authentication import AccessServices
from app.http.services import HttpServices, install, services_of
from app.main import Services

HOUSE = Path(app.__file__).parent
KEPT_PER_REQUEST = {"caller", "request_id"}
"""What a request carries with it: nothing of the application's."""


def states(path: Path) -> Iterator[str]:
    """Yield the name of everything that is asked of, or put into, the state of an application or a request."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "state":
            yield node.attr


def test_nothing_but_the_services_is_in_the_applications_state():
    own = HOUSE / "http" / "services.py"
    assert set(states(own)) == {"services"}
    elsewhere = {(path.name, name) for path in HOUSE.rglob("*.py") if path != own for name in states(path)}
    assert {(path, name) for path, name in elsewhere if name not in KEPT_PER_REQUEST | {"in_", "is_"}} == set()


def test_the_services_are_frozen_and_hold_what_every_room_declares(new_service):
    services = new_service().services
    assert is_dataclass(services)
    rooms = [one for one in Services.__mro__ if is_dataclass(one)]
    assert {HttpServices, AccessServices} < set(rooms)
    for one in fields(Services):
        getattr(services, one.name)
    with pytest.raises(FrozenInstanceError):
        services.queue = None


def test_a_room_whose_part_is_missing_is_named():
    application = FastAPI()
    install(application, object())
    with pytest.raises(TypeError, match="AccessServices"):
        services_of(application, AccessServices)

"""The OpenAPI document as generators and readers use it: valid, named, described, with examples that are valid."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator

from app.main import create_app
from app.settings import Settings


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict:
    folder: Path = tmp_path_factory.mktemp("openapi")
    return create_app(Settings(data_dir=folder), workers=0).openapi()


CONFIG = Path(__file__).resolve().parents[3] / "examples" / "openapi-python-client.yml"


def operations(document: dict) -> Iterator[tuple[str, dict]]:
    for path, calls in document["paths"].items():
        for method, operation in calls.items():
            yield f"{method.upper()} {path}", operation


def test_the_document_is_valid_by_its_own_specification(document):
    assert [error.message for error in OpenAPIV31SpecValidator(document).iter_errors()] == []


def test_every_operation_has_a_name_of_its_own_and_a_summary(document):
    """Names that client generators make functions of: a verb and what it is done to, once."""
    names = {where: one["operationId"] for where, one in operations(document)}
    assert len(set(names.values())) == len(names)
    assert [name for name in names.values() if not re.fullmatch(r"[a-z]+(_[a-z]+)*", name)] == []
    summaries = {where: one["summary"] for where, one in operations(document)}
    assert [where for where, text in summaries.items() if not 5 <= len(text) <= 120] == []


def test_every_operation_has_its_problems(document):
    """Those under /api/v1, that is; health and figures answer by themselves."""
    for where, operation in operations(document):
        if "/api/v1" not in where:
            continue
        for status in ("401", "403", "422", "default"):
            content = operation["responses"][status]["content"]
            assert content == {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}, where


def test_every_schema_property_and_parameter_is_described(document):
    schemas = document["components"]["schemas"]
    bare = [name for name, one in schemas.items() if not one.get("description")]
    for name, one in schemas.items():
        bare += [f"{name}.{own}" for own, held in one.get("properties", {}).items() if not held.get("description")]
    for where, operation in operations(document):
        bare += [f"{where} {one['name']}" for one in operation.get("parameters", []) if not one.get("description")]
    assert bare == []


def test_every_parameter_has_an_example_that_its_schema_allows(document):
    for where, operation in operations(document):
        for one in operation.get("parameters", []):
            rooted = {**one["schema"], "$defs": document["components"]["schemas"]}
            faults = [fault.message for fault in Draft202012Validator(_local(rooted)).iter_errors(one["example"])]
            assert faults == [], (where, one["name"])
            assert one["example"] is not None, (where, one["name"])


def test_times_are_marked_as_such(document):
    ends_with_at = [
        (name, own, held)
        for name, one in document["components"]["schemas"].items()
        for own, held in one.get("properties", {}).items()
        if own.endswith("_at")
    ]
    assert len(ends_with_at) > 20
    assert [where for *where, held in ends_with_at if "date-time" not in str(held)] == []


def test_every_body_and_answer_has_a_schema(document):
    for where, operation in operations(document):
        for part in (operation.get("requestBody", {}), *operation["responses"].values()):
            for kind, media in part.get("content", {}).items():
                assert media.get("schema"), (where, kind)


def test_every_object_has_an_example_that_its_schema_allows(document):
    schemas = document["components"]["schemas"]
    root = {"$defs": schemas}
    seen = 0
    for name, schema in schemas.items():
        if schema.get("type") != "object":
            continue
        for example in schema["examples"]:
            rooted = {"$ref": f"#/$defs/{name}"} | root
            text = Draft202012Validator(_local(rooted)).iter_errors(example)
            assert [f"{error.json_path}: {error.message}" for error in text] == [], name
            seen += 1
    assert seen > 100


def _local(schema: object) -> object:
    """Return a schema with its references into the document turned into such within itself."""
    if isinstance(schema, dict):
        return {
            key: one.replace("#/components/schemas/", "#/$defs/") if key == "$ref" else _local(one)
            for key, one in schema.items()
        }
    return [_local(one) for one in schema] if isinstance(schema, list) else schema


@pytest.fixture(scope="module")
def generated(document: dict, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The client that a generator makes of the document, on the path of imports."""
    folder: Path = tmp_path_factory.mktemp("generated")
    (folder / "openapi.json").write_text(json.dumps(document), encoding="utf-8")
    options = ["--path", folder / "openapi.json", "--config", CONFIG, "--output-path", folder / "client"]
    command = [Path(sys.executable).with_name("openapi-python-client"), "generate", *options]
    made = subprocess.run(command, capture_output=True, text=True, timeout=200, cwd=folder, check=False)
    assert (made.returncode, [line for line in made.stdout.splitlines() if "WARNING" in line or "ERROR" in line]) == (
        0, [],
    ), made.stdout + made.stderr  # fmt: skip
    sys.path.insert(0, str(folder / "client"))
    yield folder / "client"
    sys.path.remove(str(folder / "client"))


def test_a_generated_client_has_every_call_and_speaks_with_the_service(generated, document, service, names):
    """Generated without a warning; a function for each operation; it creates, reads and is refused by name."""
    made = {path.stem for path in (generated / "magcal_api" / "api").rglob("*.py")} - {"__init__"}
    assert {one["operationId"] for _, one in operations(document)} <= made
    client = importlib.import_module("magcal_api").AuthenticatedClient(base_url=service.url, token=service.admin_key)
    calls = "magcal_api.api.satellites"
    create = importlib.import_module(f"{calls}.create_satellite").sync
    body = importlib.import_module("magcal_api.models").SatelliteCreate(id=next(names), name="Lantern")
    with client:
        kept = create(client=client, body=body)
        assert (kept.id, kept.name, kept.created_at.tzinfo is not None) == (body.id, "Lantern", True)
        read = importlib.import_module(f"{calls}.get_satellite").sync(body.id, client=client)
        assert read == kept
        refused = importlib.import_module(f"{calls}.create_satellite").sync(client=client, body=body)
        assert (refused.status, refused.code) == (409, "conflict")

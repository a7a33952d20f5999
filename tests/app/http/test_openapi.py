"""The OpenAPI document as generators and readers use it: valid, named, described, with examples that are valid."""

from __future__ import annotations

import importlib
import io
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator

from app.main import create_app
from app.settings import Settings
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples


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


def test_every_schema_and_property_has_an_example_that_it_allows(document):
    schemas = document["components"]["schemas"]
    root = _local({"$defs": schemas})
    seen = 0
    for name, schema in schemas.items():
        held = {f"{name}.{own}": one for own, one in schema.get("properties", {}).items() if "$ref" not in one}
        for where, one in {name: schema, **held}.items():
            assert len(one["examples"]) >= 1, where
            for example in one["examples"]:
                rooted = {"$ref": f"#/$defs/{name}"} if where == name else _local(one)
                text = Draft202012Validator(rooted | root).iter_errors(example)
                assert [f"{error.json_path}: {error.message}" for error in text] == [], where
                seen += 1
    assert seen > 1000


UNITS = {
    "_nt_per_m": "nT/m", "_nt": "nT", "_deg_s": "deg/s", "_deg": "deg", "_km_s": "km/s", "_km": "km", "_days": "day",
    "_hours": "h", "_bytes": "byte", "_m": " m", "_s": " s",
}  # fmt: skip
VECTORS = ("_nt", "_km", "_km_s", "vector_deg", "rotation", "matrix")
FRAMES = re.compile("frame|axes|axis|magnitude|\\|B\\|")


def test_what_has_a_unit_says_it_and_what_is_a_vector_says_its_frame(document):
    described = {
        (name, own): (one.get("description", ""), "array" in {one.get("type")})
        for name, schema in document["components"]["schemas"].items()
        for own, one in schema.get("properties", {}).items()
    }
    for where, operation in operations(document):
        described |= {(where, one["name"]): (one["description"], False) for one in operation.get("parameters", [])}
    without_unit, without_frame = [], []
    for (where, name), (text, is_list) in described.items():
        unit = next((unit for suffix, unit in UNITS.items() if name.endswith(suffix)), None)
        if unit is not None and unit not in text:
            without_unit.append(f"{where}.{name}: {text}")
        if is_list and name.endswith(VECTORS) and not FRAMES.search(text):
            without_frame.append(f"{where}.{name}: {text}")
    assert (without_unit, without_frame) == ([], [])


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


def test_a_generated_client_uploads_calibrates_reads_and_activates(generated, service, names):
    """The whole way through functions that the generator has made, nothing written by hand."""
    flown = simulated(SESSIONS[0], 300).samples

    def call(module: str):
        return importlib.import_module(f"magcal_api.api.{module}").sync

    models = importlib.import_module("magcal_api.models")
    file = importlib.import_module("magcal_api.types").File
    client = importlib.import_module("magcal_api").AuthenticatedClient(base_url=service.url, token=service.admin_key)
    name = next(names)
    with client:
        call("satellites.create_satellite")(client=client, body=models.SatelliteCreate(id=name))
        sensor = models.MagnetometerCreate(id="mgm", unit=models.MagnetometerCreateUnit("nT"), noise_nt=100.0)
        call("satellites.create_magnetometer")(name, client=client, body=sensor)
        orbits = call("orbits.create_orbits")(name, client=client, body=file(payload=io.BytesIO(tle_text().encode())))
        assert orbits.items[0].satellite == name
        sent = file(payload=io.BytesIO(write_samples(flown, "csv")))
        session = call("sessions.upload_session")(name, client=client, body=sent, magnetometer="mgm")
        assert session.samples == len(flown)
        wanted = models.CalibrationBody(kind="calibration", session_ids=[session.id])
        job = call("jobs.create_job")(client=client, body=wanted)
        deadline = time.monotonic() + 120
        while job.state in {"queued", "running"}:
            assert time.monotonic() < deadline
            time.sleep(0.2)
            job = call("jobs.get_job")(job.id, client=client)
        assert job.state == "succeeded"
        made = call("parameter_sets.list_parameter_sets")(client=client, session=session.id).items[0]
        assert (
            made.parameters.bias_nt
            == call("parameter_sets.get_parameter_set")(made.id, client=client).parameters.bias_nt
        )
        body = models.ActivateBody(force=True, reason="as the walk goes")
        put = call("parameter_sets.activate_parameter_set")(made.id, client=client, body=body)
        assert (put.id, put.status) == (made.id, "active")
        short = call("parameter_sets.list_parameter_sets")(
            client=client, session=session.id, view=models.ListParameterSetsView("summary")
        ).items
        assert [one.id for one in short] == [made.id]

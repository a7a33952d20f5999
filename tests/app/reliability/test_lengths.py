"""Text that a client sends is as long as its column holds: SQLite would keep more, PostgreSQL would not."""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
from collections.abc import Iterator, Mapping

import pytest
from pydantic import BaseModel
from sqlalchemy import String

import app
from app.http.schemas import Body, Filter
from app.main import create_app
from app.server import prepare
from app.settings import Settings
from app.storage.database import Base
from magcal_core.simulation.dekart_mission import tle_text

CSV = {"content-type": "text/csv"}
NOT_IN_A_COLUMN = {"regressors[]", "columns[]", "valid_values[]", "without[]"}
"""Texts inside JSON, whose length is that of the whole document, which is bounded."""
KEPT_OTHERWISE = {"MagnetometerCreate.unit", "MagnetometerChange.unit", "FieldFileUpload.name"}
"""Counts are kept as nT, with the nT in one; the name of a field file is not that of an index, which is shorter."""
TOKEN = re.compile(r"(?:\[[^]]*\]|\\.|[^\\])(?:\{(?:\d+,)?(\d+)\})?")
LONG = "n" * 400


def modules() -> Iterator[str]:
    for found in pkgutil.walk_packages(app.__path__, "app."):
        if found.name.rpartition(".")[2] in {"schemas", "key_schemas", "calibration_options", "endpoints", "tables"}:
            yield found.name


def longest(schema: Mapping[str, object]) -> float:
    """Return how long a text of a schema may be at the most."""
    if "enum" in schema or "const" in schema:
        return max(len(str(one)) for one in schema.get("enum", [schema.get("const")]))  # type: ignore[attr-defined]
    if schema.get("format") in {"date-time", "date", "binary"}:
        return 40.0
    pattern = str(schema.get("pattern", "")).strip("^$")
    if re.fullmatch(r"\(\w+(\|\w+)*\)", pattern):
        return float(max(len(one) for one in pattern.strip("()").split("|")))
    if pattern and not re.search(r"[*+]|,\}", re.sub(r"\[[^]]*\]", "x", pattern)):
        return float(sum(int(one[1] or 1) for one in TOKEN.finditer(pattern)))
    return float(schema.get("maxLength", "inf"))  # type: ignore[arg-type]


def texts(schema: dict, names: dict, place: str = "") -> Iterator[tuple[str, dict]]:
    """Yield every text inside a schema, with the member that has it."""
    if "$ref" in schema:
        schema = names[schema["$ref"].rpartition("/")[2]]
    for kind in ("anyOf", "oneOf", "allOf"):
        for one in schema.get(kind, ()):
            yield from texts(one, names, place)
    if schema.get("type") == "string":
        yield place, schema
    if schema.get("type") == "array" and "items" in schema:
        yield from texts(schema["items"], names, f"{place}[]")
    for name, one in schema.get("properties", {}).items():
        yield from texts(one, names, name)


def models() -> list[type[BaseModel]]:
    """Return every model of what clients send."""
    for name in modules():
        importlib.import_module(name)

    def below(kind: type) -> Iterator[type]:
        for one in kind.__subclasses__():
            yield one
            yield from below(one)

    found = [one for kind in (Body, Filter) for one in below(kind) if one.__module__.startswith("app.")]
    return [one for one in found if not one.__subclasses__()]


def test_every_text_of_a_request_has_a_bound(tmp_path):
    """Parameters and bodies of the API document; paths are looked up, and kept only once they were found."""
    settings = Settings(data_dir=tmp_path)
    prepare(settings)
    application = create_app(settings, workers=0)
    application.state.services.database.close()
    document = application.openapi()
    names = document["components"]["schemas"]
    found = set()
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            sent = [(one["name"], one["schema"]) for one in call.get("parameters", ()) if one["in"] != "path"]
            bodies = call.get("requestBody", {}).get("content", {})
            sent += [("", one.get("schema", {})) for kind, one in bodies.items() if kind == "application/json"]
            for name, schema in sent:
                unbounded = {place for place, one in texts(schema, names, name) if longest(one) == float("inf")}
                found |= {f"{method} {path} {place}" for place in unbounded - NOT_IN_A_COLUMN}
    assert found == set()


def test_no_text_of_a_request_may_be_longer_than_the_column_of_its_name():
    """A model's member and the columns of that name in the tables of its room, or of the room that it writes to."""
    rooms: dict[str, dict[str, int]] = {}
    for mapper in Base.registry.mappers:
        room = mapper.class_.__module__.split(".")[1]
        for column in mapper.local_table.columns:
            if isinstance(column.type, String) and column.type.length is not None:
                known = rooms.setdefault(room, {})
                known[column.name] = min(column.type.length, known.get(column.name, 1 << 30))
    too_long, checked = set(), 0
    for model in models():
        columns, document = rooms.get(model.__module__.split(".")[1], {}), model.model_json_schema()
        for name in columns.keys() & document.get("properties", {}).keys():
            checked += 1
            for place, schema in texts(document["properties"][name], document.get("$defs", {}), name):
                if place == name and longest(schema) > columns[name]:
                    too_long.add(f"{model.__name__}.{name}")
    assert too_long <= KEPT_OTHERWISE
    assert checked > 20


def rows(first: int) -> str:
    return "time,bx,by,bz,ref_b\n" + "".join(
        f"2020-01-01T00:00:{s:02d}Z,{20000 + first},{s},2,20000\n" for s in range(20)
    )


def omm() -> bytes:
    one = {
        "OBJECT_NAME": LONG, "OBJECT_ID": "2020-068H", "EPOCH": "2022-02-19T22:37:44.130", "MEAN_MOTION": 15.04439956,
        "ECCENTRICITY": 0.0018587, "INCLINATION": 97.7242, "RA_OF_ASC_NODE": 39.424, "ARG_OF_PERICENTER": 157.76,
        "MEAN_ANOMALY": 202.4433, "BSTAR": 0.0, "MEAN_MOTION_DOT": 0.0, "MEAN_MOTION_DDOT": 0.0,
        "NORAD_CAT_ID": 46493, "EPHEMERIS_TYPE": 0, "CLASSIFICATION_TYPE": "U", "ELEMENT_SET_NO": 999,
        "REV_AT_EPOCH": 1, "CENTER_NAME": "EARTH", "REF_FRAME": "TEME", "TIME_SYSTEM": "UTC",
        "MEAN_ELEMENT_THEORY": "SGP4",
    }  # fmt: skip
    return json.dumps([one]).encode()


TLE_LINES = tle_text().splitlines()[1:3]
CALLS = {
    "content type": ("/satellites/a/sessions?magnetometer=m", rows(1), {"content-type": f"text/csv; x={LONG}"}),
    "request id": ("/satellites/a/sessions?magnetometer=m", rows(2), CSV | {"x-request-id": LONG}),
    "file name": ("/satellites/a/sessions?magnetometer=m", rows(3), CSV | {"content-disposition": LONG}),
    "column name": ("/satellites/a/sessions?magnetometer=m", rows(4).replace("ref_b\n", f"ref_b,{LONG}\n"), CSV),
    "name of a TLE": ("/satellites/a/orbits", "\n".join([LONG, *TLE_LINES]) + "\n", {"content-type": "text/plain"}),
    "name of an OMM": ("/satellites/a/orbits", omm(), {"content-type": "application/json"}),
    "name of an index": ("/indices", f"# {LONG}\ntime,{LONG}\n2024-05-07T00:00:00Z,1\n", CSV),
    "comment of a field file": ("/field-files", f"# {LONG}\n1 1 1 2020.0\n", {"content-type": "text/plain"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def test_both_databases_take_and_refuse_the_same_lengths(new_service, request, kind):
    """At the bound 2xx, one more 422; a long text inside a file is kept or refused, and never an error of ours."""
    url = request.getfixturevalue("postgres_url") if kind == "postgres" else None
    with new_service(database_url=url).client() as api:
        api.post("/satellites", json={"id": "a"}).raise_for_status()
        api.post("/satellites/a/magnetometers", json={"id": "m", "unit": "nT"}).raise_for_status()
        for length, status in ((200, 201), (201, 422)):
            named = {"id": f"b{length}", "name": "n" * length}
            assert api.post("/satellites", json=named).status_code == status
            made = api.post("/keys", json={"scopes": ["read"], "name": "n" * length})
            assert made.status_code == status, made.text
        for length, status in ((63, 201), (64, 422)):
            assert api.post("/satellites", json={"id": "c" * length}).status_code == status
        answers = {what: api.post(path, content=sent, headers=head) for what, (path, sent, head) in CALLS.items()}
    found = {what: answer.status_code for what, answer in answers.items()}
    assert set(found.values()) <= {200, 201, 422}, found
    assert {found[what] for what in ("content type", "request id", "file name")} == {201}

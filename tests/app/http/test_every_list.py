"""Every list of the API's own description: counted, sorted, searched and shortened on request, in parts that join."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import httpx2
import pytest

from app.main import create_app
from app.settings import Settings
from tests.app.access.conftest import CSV, TLE, build_world, ended

ASKED = {"limit", "cursor", "total", "q", "sort", "view"}
SUMMARY_BYTES = 500
MOST = {"limit": 1000}
SECOND_INDEX = b"hour,dst_nt\n2001-05-11T00:00:00Z,-10\n"
COUNTS_SATELLITES = "/overview"
TIES = "/fleet"
"""Rows of equal value keep the order of their names, either way round."""


@dataclass(frozen=True)
class ListOf:
    """One list of the description."""

    path: str
    operation: dict

    @property
    def orders(self) -> list[str]:
        """The orders that it offers."""
        schema = next(one["schema"] for one in self.operation["parameters"] if one["name"] == "sort")
        return list(schema["enum"])


def lists_of(document: dict) -> list[ListOf]:
    """Return every call that answers items."""
    schemas = document["components"]["schemas"]

    def has_items(schema: dict) -> bool:
        if "$ref" in schema:
            return has_items(schemas[schema["$ref"].rpartition("/")[2]])
        parts = schema.get("anyOf", [])
        return "items" in schema.get("properties", {}) or schema.get("type") == "array" or any(map(has_items, parts))

    found = []
    for path, calls in document["paths"].items():
        content = calls.get("get", {}).get("responses", {}).get("200", {}).get("content", {})
        if path.startswith("/api/v1") and has_items(content.get("application/json", {}).get("schema", {})):
            found.append(ListOf(path.removeprefix("/api/v1"), calls["get"]))
    return found


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return create_app(Settings(data_dir=tmp_path_factory.mktemp("lists")), workers=0).openapi()


@pytest.fixture(scope="module")
def lists(document: dict) -> list[ListOf]:
    """The lists that come in parts."""
    return [one for one in lists_of(document) if "x-whole-list" not in one.operation]


@pytest.fixture(scope="module")
def filled(
    serving: Callable[[Settings], Iterator], tmp_path_factory: pytest.TempPathFactory, data_dir
) -> Iterator[tuple[httpx2.Client, dict[str, str]]]:
    """A service with two of everything that is listed, and what stands for the names in addresses."""
    folder = tmp_path_factory.mktemp("two-of-everything")
    for service in serving(Settings(data_dir=folder, workers=1, min_free_mb=0, webhook_hosts="127.0.0.1")):
        with service.client() as admin:
            world = build_world(admin, "heron")
            ids = world.ids
            place = "/satellites/heron/magnetometers"
            admin.post("/satellites", json={"id": "lantern", "name": "Lantern"}).raise_for_status()
            admin.post(place, json={"id": "other", "unit": "uT", "columns": {"bx": "x"}}).raise_for_status()
            path = "/satellites/heron/sessions"
            sent = world.telemetry.rpartition(b"\n")[0].rpartition(b"\n")[0] + b"\n"
            admin.post(path, params={"magnetometer": "mgm"}, content=sent, headers=CSV).raise_for_status()
            admin.post("/indices", content=SECOND_INDEX, headers=CSV).raise_for_status()
            admin.post(
                "/field-files", content=(data_dir / "field" / "model.cof").read_bytes(), headers=TLE
            ).raise_for_status()
            hook = {"url": "http://127.0.0.1:9/", "events": ["parameter_set.activated"]}
            ids["webhook_id"] = admin.post("/webhooks", json=hook).raise_for_status().json()["id"]
            made = admin.post(f"/jobs/{ids['job_id']}/retry").raise_for_status().json()
            second = ended(admin, made["id"])["result"]["parameter_set_id"]
            for one in (second, ids["parameter_set_id"]):
                body = {"force": True, "reason": "seen"}
                admin.post(f"/parameter-sets/{one}/activate", json=body).raise_for_status()
                admin.post(f"/parameter-sets/{ids['parameter_set_id']}/aboard", json={"state": "uploaded"})
            for subject in (
                "/satellites/heron", f"{place}/mgm", f"/sessions/{ids['session_id']}",
                f"/parameter-sets/{ids['parameter_set_id']}",
            ):  # fmt: skip
                for text in ("The boom is out.", "It is in again."):
                    admin.post(f"{subject}/notes", json={"text": text}).raise_for_status()
            rest(admin, ids["webhook_id"])
            yield admin, ids


def rest(admin: httpx2.Client, webhook_id: str) -> None:
    """Wait until no job runs and both activations are on their way."""
    deadline = time.monotonic() + 90
    while True:
        counts = admin.get("/jobs?total=true").json()["counts"]
        sent = admin.get(f"/webhooks/{webhook_id}/deliveries").json()["items"]
        if not counts.get("queued") and not counts.get("running") and len(sent) == 2:
            return
        assert time.monotonic() < deadline, (counts, sent)
        time.sleep(0.2)


def asked(client: httpx2.Client, address: str, **query: object) -> dict:
    answer = client.get(address, params=query)
    assert answer.status_code == 200, (address, query, answer.text)
    return answer.json()


def names_of(items: list[dict]) -> list[str]:
    """What tells items apart: an id, or where they have none all that they say."""
    return [str(one["id"]) if "id" in one else json.dumps(one, sort_keys=True) for one in items]


def test_every_list_is_counted_sorted_searched_and_shortened_or_says_why_not(document: dict) -> None:
    found = lists_of(document)
    assert len(found) >= 20
    for one in found:
        reason = one.operation.get("x-whole-list")
        if reason is not None:
            assert len(reason) > 40, one.path
            continue
        parameters = {each["name"]: each for each in one.operation["parameters"]}
        assert parameters.keys() >= ASKED, one.path
        assert parameters["q"]["description"].startswith("Part of "), one.path
        assert one.orders, one.path


def test_every_list_says_its_total_on_request(filled, lists: list[ListOf]) -> None:
    client, ids = filled
    for one in lists:
        address = one.path.format_map(ids)
        whole = asked(client, address, total="true", **MOST)
        assert len(whole["items"]) >= 2, one.path
        assert "total" not in asked(client, address, total="false", **MOST), one.path
        assert asked(client, address, total="true", limit=1)["total"] == whole["total"], one.path
        if one.path != COUNTS_SATELLITES:
            assert whole["total"] == len(whole["items"]), one.path


def test_every_order_of_every_list_turns_round_and_its_parts_join(filled, lists: list[ListOf]) -> None:
    client, ids = filled
    for one in lists:
        address = one.path.format_map(ids)
        found = {}
        for order in one.orders:
            found[order] = names_of(asked(client, address, sort=order, **MOST)["items"])
            joined, cursor = [], None
            while True:
                part = asked(client, address, sort=order, limit=1, **({"cursor": cursor} if cursor else {}))
                joined += names_of(part["items"])
                cursor = part["next"]
                if cursor is None:
                    break
            assert joined == found[order], (one.path, order)
        assert len({frozenset(names) for names in found.values()}) == 1, one.path
        for order, names in found.items():
            if f"-{order}" in found and one.path != TIES:
                turned = names[::-1]
                assert found[f"-{order}"] == turned or one.path == COUNTS_SATELLITES, (one.path, order)


def test_every_list_is_searched(filled, lists: list[ListOf]) -> None:
    """By some text of its first item it is found, by one that nothing has nothing is."""
    client, ids = filled
    for one in lists:
        address = one.path.format_map(ids)
        first = asked(client, address, **MOST)["items"][0]
        nothing = asked(client, address, q="no-such-thing", total="true", **MOST)
        assert (nothing["items"], nothing["total"]) == ([], 0), one.path
        texts = [value[:200] for value in first.values() if isinstance(value, str) and value]
        by_text = {text: names_of(asked(client, address, q=text.upper(), **MOST)["items"]) for text in texts}
        assert any(names_of([first])[0] in names for names in by_text.values()), one.path


def test_a_summary_of_every_list_has_items_of_under_500_bytes_that_say_what_whole_ones_say(
    filled, lists: list[ListOf]
) -> None:
    client, ids = filled
    for one in lists:
        address = one.path.format_map(ids)
        whole, short = (asked(client, address, view=view, **MOST)["items"] for view in ("full", "summary"))
        assert len(whole) == len(short), one.path
        for full, brief in zip(whole, short, strict=True):
            assert len(json.dumps(brief, separators=(",", ":")).encode()) < SUMMARY_BYTES, (one.path, brief)
            assert brief.keys() - full.keys() <= {"grade", "rms_nt"}, one.path
            assert {name: full[name] for name in brief if name in full} == {
                name: value for name, value in brief.items() if name in full
            }, one.path


def test_an_order_or_a_view_that_a_list_does_not_have_is_refused_by_name(filled, lists: list[ListOf]) -> None:
    client, ids = filled
    for one in lists:
        for query in ({"sort": "colour"}, {"view": "tiny"}):
            answer = client.get(one.path.format_map(ids), params=query)
            assert answer.status_code == 422, (one.path, query)
            assert next(iter(query)) in answer.json()["errors"][0]["where"], answer.text

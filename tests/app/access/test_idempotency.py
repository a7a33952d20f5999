"""Requests with an Idempotency-Key that meet the first one before it has ended."""

from __future__ import annotations

import http.client
import json
import time
from urllib.parse import urlsplit

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples

ARRIVED_S = 1.0
"""By then the service has begun with a request whose head it was sent."""


def test_a_second_request_waits_while_the_first_with_its_key_is_still_arriving(new_service):
    """F11: 409 with Retry-After, nothing made twice; after the first has ended its session is the answer."""
    service = new_service(workers=0)
    content = write_samples(simulated(SESSIONS[0], 60).samples, "csv")
    path = "/api/v1/satellites/one/sessions?magnetometer=mgm"
    with service.client() as api:
        api.post("/satellites", json={"id": "one"}).raise_for_status()
        api.post("/satellites/one/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
        first = http.client.HTTPConnection(urlsplit(service.url).netloc, timeout=60)
        first.putrequest("POST", path)
        for name, value in (
            ("Authorization", f"Bearer {service.admin_key}"),
            ("Content-Type", "text/csv"),
            ("Content-Length", str(len(content))),
            ("Idempotency-Key", "pass-1"),
        ):
            first.putheader(name, value)
        first.endheaders(content[:1000])
        time.sleep(ARRIVED_S)
        again = {"content": content, "headers": {"content-type": "text/csv", "idempotency-key": "pass-1"}}
        second = api.post("/satellites/one/sessions?magnetometer=mgm", **again)
        assert (second.status_code, second.json()["code"]) == (409, "in_progress")
        assert int(second.headers["retry-after"]) >= 1
        first.send(content[1000:])
        answer = first.getresponse()
        made = json.loads(answer.read())
        assert answer.status == 201
        third = api.post("/satellites/one/sessions?magnetometer=mgm", **again)
        assert (third.status_code, third.json()["id"]) == (200, made["id"])
        assert len(api.get("/sessions").json()["items"]) == 1
        first.close()

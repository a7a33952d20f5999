"""Notes over HTTP: beside each kind of thing, with author and time, and not beside what the key does not reach."""

import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples


@pytest.fixture
def session_id(api, satellite) -> str:
    content = write_samples(simulated(SESSIONS[0], 60).samples, "csv")
    path = f"/satellites/{satellite}/sessions?magnetometer=mgm"
    return api.post(path, content=content, headers={"content-type": "text/csv"}).json()["id"]


def test_notes_keep_text_author_and_time_beside_their_thing(service, api, satellite, session_id):
    made = api.post("/keys", json={"scopes": ["operate", "read"], "name": "night shift"}).json()
    places = {
        f"/satellites/{satellite}/notes": ("satellite", satellite),
        f"/satellites/{satellite}/magnetometers/mgm/notes": ("magnetometer", f"{satellite}/mgm"),
        f"/sessions/{session_id}/notes": ("session", session_id),
    }
    with service.client(made["key"]) as operator:
        for path, (kind, subject) in places.items():
            note = operator.post(path, json={"text": "Torquers on <b>since</b> 03:10\nsee log"}).json()
            assert (note["kind"], note["subject"], note["satellite"]) == (kind, subject, satellite)
            assert (note["text"], note["author"]) == ("Torquers on <b>since</b> 03:10\nsee log", "night shift")
            operator.post(path, json={"text": "over"}).raise_for_status()
            assert [one["text"] for one in api.get(path).json()["items"]] == ["over", note["text"]]
    lines = [one for one in api.get("/audit").json()["items"] if one["satellite_id"] == satellite]
    assert sum(one["action"] == "note.create" and one["key_id"] == made["id"] for one in lines) == 6


def test_notes_beside_what_is_not_there_or_not_reached_are_refused(service, api, satellite, session_id):
    assert api.post(f"/satellites/{satellite}/notes", json={"text": ""}).status_code == 422
    assert api.post(f"/satellites/{satellite}/notes", json={"text": "x" * 4001}).status_code == 422
    assert api.get("/parameter-sets/" + "0" * 32 + "/notes").status_code == 404
    with service.client(service.key("operate", "read", satellites=["another"])) as bound:
        assert bound.get(f"/sessions/{session_id}/notes").status_code == 404
        assert bound.post(f"/satellites/{satellite}/magnetometers/mgm/notes", json={"text": "x"}).status_code == 404
    with service.client(service.key("read")) as reader:
        assert reader.post(f"/satellites/{satellite}/notes", json={"text": "x"}).status_code == 403

"""What is known of a fleet is what the database has: after a change, a removal, and in turns."""

from collections.abc import Iterator, Sequence

import httpx2
import pytest
from sqlalchemy import update

from app.access.caller import SYSTEM
from app.attention import entries
from app.attention.entries import Fleet
from app.outbox.events import attention_changed, session_received
from app.outbox.log import append
from app.satellites.tables import Satellite
from app.storage.database import Database


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[str] | None]:
    """Of which satellites the database was asked, one item a time; None: of all."""
    found: list[Sequence[str] | None] = []
    plain = entries.situations

    def told(session: object, satellites: Sequence[str] | None = None) -> object:
        found.append(satellites)
        return plain(session, satellites)

    monkeypatch.setattr(entries, "situations", told)
    return found


@pytest.fixture
def fleet_of_two(api: httpx2.Client, names: Iterator[str]) -> tuple[str, str]:
    found = (next(names), next(names))
    for name in found:
        api.post("/satellites", json={"id": name}).raise_for_status()
        api.post(f"/satellites/{name}/magnetometers", json={"id": "mgm", "unit": "nT"}).raise_for_status()
    return found


def known(database: Database, fleet: Fleet) -> dict[tuple[str, str], object]:
    with database.read() as session:
        found = [one.situation for one in fleet.view(session, SYSTEM).standings]
    return {(one.satellite_id, one.magnetometer_id): one for one in found}


def test_after_a_change_its_satellites_are_asked_for_and_the_whole_is_as_if_all_were(
    service, api, fleet_of_two, asked, monkeypatch
) -> None:
    monkeypatch.setattr(entries, "TRUSTED_S", 1e9)
    fleet, (first, second) = Fleet(), fleet_of_two
    known(service.database, fleet)
    assert asked == [None]
    known(service.database, fleet)
    assert asked == [None]
    api.patch(f"/satellites/{first}", json={"name": "Renamed"}).raise_for_status()
    api.post(f"/satellites/{first}/magnetometers", json={"id": "second", "unit": "nT"}).raise_for_status()
    now = known(service.database, fleet)
    assert now[first, "mgm"].satellite_name == "Renamed"
    assert (first, "second") in now
    assert first in asked[1]
    api.delete(
        f"/satellites/{second}", params={"confirm": api.delete(f"/satellites/{second}").json()["confirm"]}
    ).raise_for_status()
    now = known(service.database, fleet)
    assert (second, "mgm") not in now
    assert None not in asked[1:]
    anew = known(service.database, Fleet())
    assert list(now) == list(anew)
    assert now == anew


def test_what_no_log_tells_of_is_seen_in_turns(service, fleet_of_two, asked, monkeypatch) -> None:
    monkeypatch.setattr(entries, "TRUSTED_S", -1.0)
    monkeypatch.setattr(entries, "changed_satellites", lambda _session, _since: set())
    fleet = Fleet()
    count = len({satellite for satellite, _ in known(service.database, fleet)})
    monkeypatch.setattr(entries, "AT_ONCE", 2)
    with service.database.write() as session:
        session.execute(update(Satellite).where(Satellite.id.in_(fleet_of_two)).values(name="Behind its back"))
    for _ in range((count + 1) // 2):
        now = known(service.database, fleet)
    assert {now[one, "mgm"].satellite_name for one in fleet_of_two} == {"Behind its back"}
    assert all(len(satellites) <= 2 for satellites in asked[1:])
    assert set().union(*asked[1:]) == {satellite for satellite, _ in now}
    fleet.look_again(fleet_of_two[0])
    known(service.database, fleet)
    assert fleet_of_two[0] in asked[-1]


def test_that_something_needs_attention_is_no_news_of_a_satellite(service, fleet_of_two, asked, monkeypatch) -> None:
    monkeypatch.setattr(entries, "TRUSTED_S", 1e9)
    monkeypatch.setattr("app.attention.situation.LATE_EVENTS", 0)
    monkeypatch.setattr("app.attention.situation.LATE_MS", -1)
    fleet = Fleet()
    known(service.database, fleet)
    with service.database.write() as session:
        append(session, [attention_changed(is_raised=True, cause="x", reason="y", satellite_id=fleet_of_two[0])])
    known(service.database, fleet)
    assert not any(fleet_of_two[0] in (satellites or ()) for satellites in asked[1:])
    with service.database.write() as session:
        append(session, [session_received(
            session_id="0" * 32, satellite_id=fleet_of_two[0], magnetometer_id="mgm", samples=0, data_from=None,
            data_until=None,
        )])  # fmt: skip
    known(service.database, fleet)
    assert fleet_of_two[0] in asked[-1]

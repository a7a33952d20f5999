"""A set in force whose life, by the trend of its sets, has ended: told with the date that the trend itself answers."""

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import httpx2
import pytest

from app.access.caller import SYSTEM
from app.attention.causes.forecast import ForecastOut
from app.attention.lives import tell_lives
from app.attention.situation import LifeFacts, SessionFacts, SetFacts, Situation, situations
from app.parameter_sets.repository import ParameterSetRepository
from tests.app.test_trends import keep
from tests.magcal_core.calibration.sessions.histories import history

NOW = datetime(2026, 6, 1, tzinfo=UTC)
PATIENCE_S = 60.0


def forecast(api: httpx2.Client, satellite: str) -> dict | None:
    answer = api.get("/attention", params={"satellite": satellite, "code": "forecast_out"}).raise_for_status()
    return next(iter(answer.json()["items"]), None)


def until(look: Callable[[], object]) -> object:
    """Return what ``look`` finds once it finds something."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := look()):
        assert time.monotonic() < deadline
        time.sleep(0.2)
    return found


def later(record: dict, days: float) -> dict:
    """Return the record of a set as if it had been made so many days later."""
    moved = {
        name: (datetime.fromisoformat(record[name]) + timedelta(days=days)).isoformat()
        for name in ("data_from", "data_until")
    }
    return record | moved


def test_the_end_of_a_life_is_told_by_itself_and_goes_with_a_newer_set(service, api, satellite):
    """Six months of sets that walk, the last of 2024: out on the day that the trend says, until a set of yesterday that
    is the same vouches for it anew."""
    place = {"satellite_id": satellite, "magnetometer_id": "mgm"}
    sets = history(21, 9, walk_nt=800.0, years=0.5).sets
    with service.database.write() as session:
        kept = [keep(session, place, one | {"status": "candidate"}) for one in sets]
        ParameterSetRepository(session, SYSTEM).activate(kept[-1], force=False)
    life = api.get(f"/satellites/{satellite}/magnetometers/mgm/trend").json()["life"]
    assert life["parameter_set_id"] == kept[-1]
    assert not life["is_capped"]
    told = until(lambda: forecast(api, satellite))
    assert (told["severity"], told["since"]) == ("act", life["until"])
    end = datetime.fromisoformat(life["until"])
    assert f"within 1 % until {end.day} {end:%b %Y}" in told["text"]
    assert told["links"]["parameter_set_id"] == kept[-1]
    assert told["action"]["label"] == "Send telemetry"

    days = (datetime.now(UTC) - datetime.fromisoformat(sets[-1]["data_until"])) / timedelta(days=1)
    with service.database.write() as session:
        keep(session, place, later(sets[-1], days - 1.0) | {"status": "candidate"})
    until(lambda: forecast(api, satellite) is None)
    life = api.get(f"/satellites/{satellite}/magnetometers/mgm/trend").json()["life"]
    assert life["parameter_set_id"] == kept[-1]
    assert datetime.fromisoformat(life["until"]) > datetime.now(UTC)


def test_nothing_is_said_where_the_trend_says_nothing(service, api, satellite):
    """Two sets are too few; a life is told once, not at every look."""
    place = {"satellite_id": satellite, "magnetometer_id": "mgm"}
    with service.database.write() as session:
        for one in history(23, 2, years=0.1).sets:
            keep(session, place, one)
    until(lambda: not tell_lives(service.database, service.services.fleet))
    with service.database.read() as session:
        (found,) = situations(session, [satellite])
    assert found.life is not None
    assert found.life.until is None
    assert forecast(api, satellite) is None


@pytest.fixture
def situation() -> Situation:
    """A set of March whose life ended ten days before ``NOW``, and a session of yesterday."""
    spring, yesterday = datetime(2026, 3, 1, tzinfo=UTC), NOW - timedelta(days=1)
    active = SetFacts("a" * 32, "accept", "active", "scalar", "j" * 32, spring, spring)
    session = SessionFacts("s" * 32, None, yesterday, yesterday, False, True, active.id, None, None, None)
    life = LifeFacts(active.id, NOW - timedelta(days=10), 0.01, is_capped=False)
    return Situation(
        "sat", None, None, "mgm", spring, None, 30.0, 7.0, 72.0,
        active=active, newest=active, session=session, life=life,
    )  # fmt: skip


def test_a_newer_set_is_put_in_force(situation):
    newer = replace(situation.active, id="b" * 32, status="candidate", data_until=NOW)
    found = ForecastOut().find(replace(situation, newest=newer), NOW)
    assert found.text.endswith("activate the newer set")
    assert (found.action.label, found.action.path) == ("Activate", f"/api/v1/parameter-sets/{newer.id}/activate")
    refused = replace(newer, grade="refuse")
    assert ForecastOut().find(replace(situation, newest=refused), NOW).action.label == "See why"


def test_a_session_since_then_is_calibrated_and_counts_as_a_witness(situation):
    found = ForecastOut().find(situation, NOW)
    assert found.text == (
        "The set in force no longer holds by its forecast: the trend vouched for it to within 1 % until 22 May 2026, "
        "10.0 days ago; calibrate the newest session"
    )
    assert (found.severity, found.action.label) == ("act", "Calibrate")
    agrees = replace(situation, session=replace(situation.session, grade="agrees"))
    assert ForecastOut().find(agrees, NOW).severity == "watch"
    assert "still agrees with it" in ForecastOut().find(agrees, NOW).text
    before = replace(agrees, session=replace(agrees.session, data_until=NOW - timedelta(days=20)))
    assert ForecastOut().find(before, NOW).severity == "act"


def test_a_life_that_lasts_or_is_of_another_set_or_capped(situation):
    """Beyond twice its span a history says nothing: that is to be watched, not a set that fails."""
    lasting = replace(situation, life=replace(situation.life, until=NOW + timedelta(seconds=1)))
    assert ForecastOut().find(lasting, NOW) is None
    other = replace(situation, life=replace(situation.life, parameter_set_id="b" * 32))
    assert ForecastOut().find(other, NOW) is None
    capped = ForecastOut().find(replace(situation, life=replace(situation.life, is_capped=True)), NOW)
    assert capped.severity == "watch"
    assert "says nothing beyond" in capped.text

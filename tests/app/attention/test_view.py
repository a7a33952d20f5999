"""What is worked out once, or not again because only the clock went on, is what is found when all is worked out."""

import random
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import cast

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from app.access.caller import SYSTEM
from app.attention import entries
from app.attention.entries import Entry, Fleet, Standing, View, standing, view_of
from app.attention.fleet import fleet_page
from app.attention.repository import AttentionRepository
from app.attention.schemas import FleetQuery
from app.attention.situation import LifeFacts, OrbitFacts, SessionFacts, SetFacts, Situation
from app.attention.tables import AttentionAcknowledgement

NOW = datetime(2026, 11, 29, 12, tzinfo=UTC)
INSTANT = timedelta(microseconds=1)


def situation_of(number: int = 0, seed: int = 0) -> Situation:
    """A magnetometer with some of what there may be of it, its times at random within the last days."""
    rng = random.Random(1000 * seed + number)  # noqa: S311  a situation is no secret

    def ago(most_days: float) -> datetime:
        return NOW - timedelta(seconds=rng.randrange(int(most_days * 86_400)))

    active = SetFacts("a" * 32, rng.choice(["accept", "weak", "refuse"]), "active", "scalar", "j" * 32, ago(9), ago(9))
    session = SessionFacts(
        f"{number:032x}", ago(90), ago(60), ago(60), True, True, "a" * 32,
        rng.choice(["agrees", "watch", "disagrees", None]), rng.choice([None, 9.0 * rng.random()]), rng.random(),
    )  # fmt: skip
    return Situation(
        f"sat-{number:03d}", rng.choice([None, f"Name {rng.randrange(5)}", "straße"]), rng.choice([None, str(number)]),
        "mgm", NOW, None, 30.0, 7.0, 72.0,
        active=rng.choice([None, active]),
        session=rng.choice([None, session, session]),
        received_at=rng.choice([None, ago(9)]),
        orbit=rng.choice([None, OrbitFacts("o" * 32, "tle", ago(30), rng.choice([None, ago(20)]), None, ago(30))]),
        life=rng.choice([None, LifeFacts("a" * 32, ago(5) + timedelta(days=2), 0.1, rng.random() < 0.5)]),
    )  # fmt: skip


def told(one: Standing) -> list[Entry]:
    return list(one.entries)


@given(seed=st.integers(0, 10_000), after_us=st.integers(0, 20 * 86_400_000_000), share=st.floats(0.0, 1.0))
def test_until_the_time_that_is_said_the_clock_changes_nothing(seed: int, after_us: int, share: float) -> None:
    now = NOW + timedelta(microseconds=after_us)
    first = standing(situation_of(seed=seed), now)
    assert first.changes_at > now
    last = first.changes_at - INSTANT
    for at in (now + share * (last - now), last):
        assert told(standing(first.situation, at)) == told(first)


@given(elapsed_us=st.integers(1, 6 * 86_400_000_000), limit_hours=st.sampled_from([0.01, 1.05, 47.95, 48.0, 72.0, 1e6]))
@example(elapsed_us=3 * 60_000_000, limit_hours=0.01)
@example(elapsed_us=3 * 60_000_000 - 1, limit_hours=0.01)
@example(elapsed_us=3 * 60_000_000 + 1, limit_hours=0.01)
@example(elapsed_us=48 * 3_600_000_000 - 1, limit_hours=0.01)
@example(elapsed_us=72 * 3_600_000_000, limit_hours=72.0)
@example(elapsed_us=72 * 3_600_000_000 - 1, limit_hours=72.0)
def test_walking_from_change_to_change_misses_none(elapsed_us: int, limit_hours: float) -> None:
    """Every change within a walk from one said time to the next is at its end: the ends are looked at by the clock."""
    bare = Situation("a", None, None, "m", NOW, None, 30.0, 7.0, limit_hours, received_at=NOW)
    now, longest = NOW + timedelta(microseconds=elapsed_us), timedelta(0)
    for _ in range(8):
        here = standing(bare, now)
        assert told(standing(bare, here.changes_at - INSTANT)) == told(here)
        longest = max(longest, here.changes_at - now)
        now = here.changes_at
    assert longest > timedelta(minutes=1)


def orders(view: View) -> tuple[Sequence[object], Sequence[object], Sequence[Entry]]:
    return [one.situation for one in view.standings], [one.situation for one in view.by_name], list(view.entries)


@pytest.mark.parametrize("seed", range(5))
def test_a_view_that_is_mended_is_one_that_is_made_anew(seed: int) -> None:
    before = [standing(situation_of(number, seed), NOW) for number in range(60)]
    rng = random.Random(seed)  # noqa: S311
    gone = {f"sat-{number:03d}" for number in rng.sample(range(70), 20)}
    come = [standing(situation_of(number, seed + 1), NOW) for number in range(70) if rng.random() < 0.7]
    new = [one for one in come if one.situation.satellite_id in gone]
    left = [one for one in before if one.situation.satellite_id not in gone]
    assert orders(view_of(new, view_of(before), gone)) == orders(view_of([*new, *left]))


class Held:
    """Attention over a view, with acknowledgements."""

    def __init__(self, view: View, known: dict[str, AttentionAcknowledgement]) -> None:
        self._held = view, known

    def known(self) -> tuple[View, dict[str, AttentionAcknowledgement]]:
        return self._held


GRADES = ("refuse", "weak", "accept")


def line_of(one: Standing, known: dict[str, AttentionAcknowledgement]) -> dict[str, object]:
    """What the fleet shows of a magnetometer, read off it one by one."""
    left = [entry for entry in one.entries if entry.id not in known]
    severities = {str(entry.finding.severity) for entry in left}
    judged, active = one.situation.judged, one.situation.active
    return {
        "place": one.situation.satellite_id,
        "name": (one.situation.satellite_name or one.situation.satellite_id).casefold(),
        "state": next((severity for severity in ("act", "watch") if severity in severities), "good"),
        "attention": len(left),
        "verdict": "none" if active is None else active.grade,
        "agreement": "none" if judged is None or judged.grade is None else judged.grade,
        "data_until": None if one.situation.session is None else one.situation.session.data_until,
        "residual_nt": None if judged is None else judged.residual_rms_nt,
    }


@pytest.mark.parametrize("state", [None, "act", "watch", "good"])
@pytest.mark.parametrize("verdict", [None, "weak", "none"])
@pytest.mark.parametrize("agreement", [None, "watch", "none"])
@pytest.mark.parametrize("q", [None, "name 3", "SAT-01", "STRASSE"])
def test_a_page_of_the_fleet_is_what_its_lines_say_one_by_one(state, verdict, agreement, q) -> None:
    view = view_of(standing(situation_of(number), NOW) for number in range(120))
    acknowledged = random.Random(1).sample(list(view.entries), 40)  # noqa: S311
    known = {
        one.id: AttentionAcknowledgement(
            entry_id=one.id, satellite_id=one.satellite_id, magnetometer_id=one.magnetometer_id
        )
        for one in acknowledged
    }
    held = cast(AttentionRepository, Held(view, known))
    asked = {"state": state, "verdict": verdict, "agreement": agreement}
    lines = [line_of(one, known) for one in view.standings if q is None or q.casefold() in one.searched]
    fitting = [one for one in lines if all(wanted in {None, one[name]} for name, wanted in asked.items())]
    found = fleet_page(held, FleetQuery(q=q, limit=1000, **asked))
    assert found.total == len(fitting)
    for name in asked:
        others = {other: wanted for other, wanted in asked.items() if other != name}
        counted = Counter(one[name] for one in lines if all(w in {None, one[o]} for o, w in others.items()))
        assert getattr(found.facets, name) == counted
    by_name = sorted(fitting, key=lambda one: (one["name"], one["place"]))
    worst = sorted(by_name, key=lambda one: (("act", "watch", "good").index(one["state"]), -one["attention"]))
    assert [(one.satellite, one.state, one.attention) for one in found.items] == [
        (one["place"], one["state"], one["attention"]) for one in worst
    ]
    for sort in ("data_until", "-data_until", "residual_nt", "-residual_nt", "name", "-name", "-verdict", "verdict"):
        rows = fleet_page(held, FleetQuery(q=q, limit=1000, sort=sort, **asked)).items
        name = sort.removeprefix("-")
        values = {
            one["place"]: GRADES.index(one[name]) if name == "verdict" and one[name] != "none" else one[name]
            for one in by_name
        }
        there = [one["place"] for one in by_name if values[one["place"]] not in {None, "none"}]
        ordered = sorted(there, key=lambda place: values[place], reverse=sort.startswith("-"))
        without = [one["place"] for one in by_name if values[one["place"]] in {None, "none"}]
        assert [row.satellite for row in rows] == ordered + without


@pytest.fixture
def fleet_of_sixty(monkeypatch: pytest.MonkeyPatch) -> None:
    """The database has sixty magnetometers, and every look is long after the one before."""
    every = [situation_of(number) for number in range(60)]

    def known(_session: object, satellites: Sequence[str] | None = None) -> list[Situation]:
        return [one for one in every if satellites is None or one.satellite_id in satellites]

    monkeypatch.setattr(entries, "situations", known)
    monkeypatch.setattr(entries, "TRUSTED_S", -1.0)
    monkeypatch.setattr(Fleet, "_in_turn", lambda _fleet, _known: set())


@pytest.mark.usefixtures("fleet_of_sixty")
def test_a_clock_that_was_set_back_has_all_judged_anew(service, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet()
    with service.database.read() as session:
        monkeypatch.setattr(entries, "utc_now", lambda: NOW + timedelta(days=4000))
        ahead = fleet.view(session, SYSTEM)
        monkeypatch.setattr(entries, "utc_now", lambda: NOW)
        back = fleet.view(session, SYSTEM)
        assert back == Fleet().view(session, SYSTEM)
    assert back.entries != ahead.entries


@pytest.mark.usefixtures("fleet_of_sixty")
def test_what_time_makes_so_is_found_though_nothing_was_written(service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two looks only those are judged anew that said that they change; the whole is as if all were."""
    fleet, judged = Fleet(), []
    plain = entries.standing

    def counted(situation: Situation, now: datetime) -> Standing:
        judged.append(situation.satellite_id)
        return plain(situation, now)

    with service.database.read() as session:
        before: Sequence[Entry] = []
        for after in (0.0, 0.02, 0.1, 0.3, 7.3, 72.5, 31 * 24.0):
            at = NOW + timedelta(hours=after)
            monkeypatch.setattr(entries, "utc_now", lambda at=at: at)
            monkeypatch.setattr(entries, "standing", counted)
            kept = fleet.view(session, SYSTEM)
            monkeypatch.setattr(entries, "standing", plain)
            anew = Fleet().view(session, SYSTEM)
            assert kept.entries == anew.entries
            assert kept.entries != before or after == 0.02
            assert orders(kept) == orders(anew)
            if after == 0.02:
                assert len(judged) < 60 + 20
            before = kept.entries

"""What happened is written with what made it true, and read in one order by everybody, on both databases."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select, update

from app.access.caller import SYSTEM, Caller
from app.outbox.events import Event, EventType, attention_changed
from app.outbox.log import append, entries_after, forget_old, newest_position, oldest_position, place_new
from app.outbox.subscription import Subscriber
from app.outbox.tables import OutboxEntry, OutboxMark
from app.settings import Settings
from app.storage.database import Database, utc_now
from app.storage.migration import upgrade


@pytest.fixture(params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def settings(request: pytest.FixtureRequest, tmp_path: Path) -> Settings:
    url = None if request.param == "sqlite" else request.getfixturevalue("postgres_url")
    return Settings(data_dir=tmp_path, database_url=url)


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    opened = Database(settings)
    upgrade(opened, settings)
    yield opened
    opened.close()


def raised(cause: str, satellite: str | None = None, owner: str | None = None) -> Event:
    event = attention_changed(is_raised=True, cause=cause, reason="because", satellite_id=satellite)
    return Event(event.type, event.data, event.satellite_id, None, owner)


def write(database: Database, *events: Event) -> None:
    with database.write() as session:
        append(session, events)


def causes(database: Database, position: int = 0, **wanted: object) -> list[str]:
    place_new(database)
    with database.read() as session:
        return [str(one.event.data["cause"]) for one in entries_after(session, position, **wanted)]  # type: ignore[arg-type]


def test_entries_come_in_the_order_of_their_commits_and_a_rollback_leaves_none(database):
    write(database, raised("a"), raised("b"))
    with pytest.raises(ZeroDivisionError), database.write() as session:
        append(session, [raised("never")])
        raise ZeroDivisionError
    write(database, raised("c"))
    assert causes(database) == ["a", "b", "c"]
    with database.read() as session:
        positions = [one.position for one in entries_after(session, 0)]
        assert positions == [1, 2, 3]
        assert [one.position for one in entries_after(session, 1, most=1)] == [2]
        assert len({one.event_id for one in entries_after(session, 0)}) == 3
        body = entries_after(session, 2)[0].body
    assert list(body) == ["type", "timestamp", "data"]
    assert body["data"] == {"cause": "c", "reason": "because", "satellite": None, "magnetometer": None}


@pytest.mark.postgres
def test_what_is_committed_late_is_not_passed_over(tmp_path, postgres_url):
    """Two transactions at once: the one that wrote first is committed last, after a reader has seen the other."""
    settings = Settings(data_dir=tmp_path, database_url=postgres_url)
    database = Database(settings)
    upgrade(database, settings)
    with database.write() as slow:
        append(slow, [raised("slow")])
        slow.flush()
        write(database, raised("fast"))
        assert causes(database) == ["fast"]
        with database.read() as session:
            seen = newest_position(session)
    assert causes(database, seen) == ["slow"]
    assert causes(database) == ["fast", "slow"]
    database.close()


def test_many_writers_and_readers_at_once_lose_nothing_and_agree(database):
    """Six writers of 25 entries each beside two readers that follow: both see all, in the same order, each once."""
    seen: list[list[tuple[int, str]]] = [[], []]
    done = threading.Event()

    def follow(mine: list[tuple[int, str]]) -> None:
        while True:
            is_last = done.is_set()
            place_new(database)
            with database.read() as session:
                found = entries_after(session, mine[-1][0] if mine else 0)
            mine += [(one.position, str(one.event.data["cause"])) for one in found]
            if is_last and not found:
                return

    def produce(number: int) -> None:
        for count in range(25):
            write(database, raised(f"{number}-{count}", f"sat-{number}"))

    readers = [threading.Thread(target=follow, args=(mine,)) for mine in seen]
    writers = [threading.Thread(target=produce, args=(number,)) for number in range(6)]
    for thread in readers + writers:
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    for thread in readers:
        thread.join()
    assert seen[0] == seen[1]
    assert [position for position, _ in seen[0]] == list(range(1, 151))
    for number in range(6):
        own = [cause for _, cause in seen[0] if cause.startswith(f"{number}-")]
        assert own == [f"{number}-{count}" for count in range(25)]


def test_a_key_sees_its_satellites_and_what_it_asked_for_itself(database):
    write(database, raised("a", "sat-a"), raised("b", "sat-b"), raised("all"), raised("own", None, "mine"))
    bound = Caller("mine", frozenset({"read"}), frozenset({"sat-a"}))
    assert causes(database, caller=bound) == ["a", "own"]
    assert causes(database, caller=SYSTEM) == ["a", "b", "all", "own"]
    assert causes(database, satellite_id="sat-b") == ["b"]
    assert causes(database, types=[EventType.JOB_ENDED]) == []


def test_a_subscriber_has_each_entry_once_over_errors_and_restarts(database):
    """What it writes and how far it is are one transaction: an error in the second entry undoes the first."""
    had: list[str] = []
    fails = [True]

    def handle(session, entry):
        cause = str(entry.event.data["cause"])
        if cause == "b" and fails.pop() if fails else False:
            raise ZeroDivisionError
        session.merge(OutboxMark(name=f"had {cause}", position=1))
        had.append(cause)

    subscriber = Subscriber("test", handle, types=[EventType.ATTENTION_RAISED], from_the_start=True)
    write(database, raised("a"), raised("b"))
    with pytest.raises(ZeroDivisionError):
        subscriber.take(database)
    with database.read() as session:
        assert session.get(OutboxMark, "had a") is None
    had.clear()
    while subscriber.take(database, most=1):
        pass
    write(database, raised("c"))
    while Subscriber("test", handle).take(database):
        pass
    assert had == ["a", "b", "c"]
    assert subscriber.take(database) == 0


def test_a_subscriber_without_a_past_begins_with_what_comes(database):
    write(database, raised("before"))
    had: list[str] = []
    subscriber = Subscriber("new", lambda _, entry: had.append(str(entry.event.data["cause"])))
    assert subscriber.take(database) == 0
    write(database, raised("after"))
    assert subscriber.take(database) == 1
    assert had == ["after"]


def test_old_entries_go_and_positions_never_begin_anew(database):
    write(database, raised("a"), raised("b"))
    place_new(database)
    with database.write() as session:
        session.execute(update(OutboxEntry).values(at=utc_now() - timedelta(days=40)))
    with database.write() as session:
        assert forget_old(session, 30.0) == 1
    write(database, raised("c"))
    place_new(database)
    with database.read() as session:
        assert (oldest_position(session), newest_position(session)) == (2, 3)
        assert session.scalars(select(OutboxEntry.id).where(OutboxEntry.position.is_(None))).all() == []

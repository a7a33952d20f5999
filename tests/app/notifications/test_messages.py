"""Messages to people: one a cause, none in quiet hours, no storm; sent through Apprise to a receiver on loopback."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select

from app.errors import UnavailableError
from app.notifications.messages import Messenger, is_quiet, letters
from app.notifications.tables import Message
from app.outbox.events import Event, attention_changed, job_ended
from app.outbox.log import append
from app.settings import Settings
from app.storage.database import Database, new_id, utc_now
from app.storage.migration import upgrade

pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")
"""Apprise looks for it on Pythons that still have it."""


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    settings = Settings(data_dir=tmp_path)
    opened = Database(settings)
    upgrade(opened, settings)
    yield opened
    opened.close()


@pytest.fixture
def messenger(database, receiver, tmp_path) -> Messenger:
    receiver.answer = lambda _body: (200, {})
    url = f"json://127.0.0.1:{receiver.port}/"
    made = Messenger(
        database,
        Settings(data_dir=tmp_path, notify_urls=url, notify_per_hour=5, public_url="https://magcal.example/"),
    )
    made.round()
    return made


def attention(cause: str, *, is_raised: bool = True) -> Event:
    return attention_changed(
        is_raised=is_raised, cause=cause, reason="it moved", satellite_id="sat", magnetometer_id="m"
    )


def job(state: str) -> Event:
    error = {"code": "too_few_samples", "detail": "12 samples; 20 needed"} if state == "failed" else None
    return job_ended(
        job_id=new_id(), kind="calibration", state=state, satellite_id="sat", magnetometer_id="m", result=None,
        error=error, parent_id=None, owner=None,
    )  # fmt: skip


def happen(database: Database, *events: Event) -> None:
    with database.write() as session:
        append(session, events)


def titles(receiver) -> list[str]:
    return [one["title"] for one in receiver.bodies()]


def test_a_cause_is_told_once_with_reason_and_link_and_again_when_it_comes_back(database, messenger, receiver):
    happen(database, attention("bias moved"), attention("bias moved"))
    messenger.round()
    happen(database, attention("bias moved"))
    messenger.round()
    assert titles(receiver) == ["sat m: bias moved"]
    assert receiver.bodies()[0]["message"] == "it moved\nhttps://magcal.example/satellites/sat"
    happen(database, attention("bias moved", is_raised=False), attention("bias moved"))
    messenger.round()
    assert titles(receiver) == ["sat m: bias moved"] * 2


def test_jobs_that_fail_are_told_until_one_succeeds_and_others_are_not(database, messenger, receiver):
    happen(database, job("succeeded"), job("cancelled"), job("failed"), job("failed"))
    messenger.round()
    assert titles(receiver) == ["sat m: calibration failed"]
    assert "12 samples; 20 needed" in receiver.bodies()[0]["message"]
    happen(database, job("succeeded"), job("failed"))
    messenger.round()
    assert len(titles(receiver)) == 2


def test_a_storm_comes_as_a_digest_and_an_hour_has_no_more_than_its_messages(database, messenger, receiver):
    """40 causes at 5 an hour: one digest of them all, then single ones, then another digest as the last."""
    happen(database, *(attention(f"cause {number}") for number in range(40)))
    messenger.round()
    assert titles(receiver) == ["magcal: 40 messages"]
    assert all(f"cause {number}\n" in receiver.bodies()[0]["message"] for number in range(40))
    for number in range(40, 60):
        happen(database, attention(f"cause {number}"))
        messenger.round()
    assert len(titles(receiver)) == 5
    with database.write() as session:  # an hour goes by
        for row in session.scalars(select(Message).where(Message.sent_at.is_not(None))):
            row.sent_at = utc_now() - timedelta(hours=2)
    messenger.round()
    assert titles(receiver)[5:] == ["magcal: 16 messages"]


def test_what_is_over_before_it_was_told_is_not_told(database, receiver, tmp_path):
    receiver.answer = lambda _body: (200, {})
    now = utc_now()
    quiet = f"{now - timedelta(minutes=5):%H:%M}-{now + timedelta(minutes=5):%H:%M}"
    url = f"json://127.0.0.1:{receiver.port}/"
    by_night = Messenger(database, Settings(data_dir=tmp_path, notify_urls=url, notify_quiet=quiet))
    by_night.round()
    happen(database, attention("a"), attention("b"), attention("a", is_raised=False))
    by_night.round()
    assert receiver.received == []
    by_day = Messenger(database, Settings(data_dir=tmp_path, notify_urls=url))
    by_day.round()
    assert titles(receiver) == ["sat m: b"]


def test_a_message_that_cannot_be_sent_is_tried_again_and_parked_after_a_day(database, messenger, receiver):
    receiver.answer = lambda _body: (500, {})
    happen(database, attention("a"))
    messenger.round()
    with database.write() as session:
        row = session.scalars(select(Message)).one()
        assert (row.state, row.attempts, row.sent_at) == ("waiting", 1, None)
        assert row.next_attempt_at > utc_now()
        row.next_attempt_at, row.created_at = utc_now(), utc_now() - timedelta(hours=25)
    messenger.round()
    with database.read() as session:
        assert session.scalars(select(Message)).one().state == "parked"


@pytest.mark.parametrize(
    ("hours", "clock", "wanted"),
    [
        (None, "12:00", False),
        ("22:00-06:00", "23:30", True),
        ("22:00-06:00", "05:59", True),
        ("22:00-06:00", "06:00", False),
        ("12:00-13:00", "12:00", True),
        ("12:00-13:00", "13:00", False),
        ("12:00-12:00", "12:00", False),
    ],
)
def test_quiet_hours_may_pass_midnight(hours, clock, wanted):
    now = datetime.strptime(f"2026-01-01 {clock}", "%Y-%m-%d %H:%M").replace(tzinfo=UTC)
    assert is_quiet(hours, now) is wanted


def test_letters_never_exceed_the_hour():
    waiting = [
        Message(id=str(n), cause=str(n), title=str(n), text="", state="waiting", attempts=0,
                next_attempt_at=utc_now(), created_at=utc_now())
        for n in range(4)
    ]  # fmt: skip
    for sent in range(7):
        found = letters(waiting, sent, 5)
        assert len(found) <= max(0, 5 - sent)
        assert not found or sorted(id_ for one in found for id_ in one.ids) == ["0", "1", "2", "3"]


def test_a_url_that_apprise_does_not_know_is_refused_without_showing_it(database, tmp_path):
    with pytest.raises(UnavailableError, match="URL number 1") as refused:
        Messenger(database, Settings(data_dir=tmp_path, notify_urls="nonsense://secret"))
    assert "secret" not in refused.value.message

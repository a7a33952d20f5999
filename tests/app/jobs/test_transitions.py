"""The states of a job: which follow which, that one module writes them, and that every end is told."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import delete, select, text

import app
from app.access.caller import SYSTEM
from app.errors import ConflictError
from app.jobs import transitions
from app.jobs.execution.leases import LostClaimError, bury_lost, claim_one, finish, hand_back, lapsed_by_clock
from app.jobs.repository import JobRepository
from app.jobs.tables import Job
from app.jobs.transitions import ALLOWED, ENDED, TransitionError, counts_of, new_job
from app.outbox.tables import OutboxEntry
from app.settings import Settings
from app.storage.database import Database
from app.storage.migration import upgrade

HOUSE = Path(app.__file__).parent
OWNER = HOUSE / "jobs" / "transitions.py"
MOST_LOST = 3
LAPSED_S, LONG_S = -1.0, 600.0


def writes(tree: ast.AST) -> Iterator[int]:
    """Yield the line of everything that gives a state to a job: made, changed as an object, or by a statement."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called, about = ast.unparse(node.func), ast.unparse(node)
            of_a_job = called == "Job" or ("update(Job" in about or "update(JOBS" in about or "insert(Job" in about)
            is_setter = called == "Job" or called.endswith(".values")
            given_state = any(one.arg in {"state", None} for one in node.keywords) or (
                called.endswith(".values") and bool(node.args)
            )
            if of_a_job and is_setter and given_state:
                yield node.lineno
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            if isinstance(target, ast.Attribute) and target.attr == "state" and "job" in ast.unparse(target).lower():
                yield node.lineno


def test_no_other_module_writes_a_jobs_state():
    found = {
        f"{path.relative_to(HOUSE)}:{line}"
        for path in HOUSE.rglob("*.py")
        if path != OWNER
        for line in writes(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert found == set()


@pytest.mark.parametrize(
    "code",
    [
        "Job(id=1, state='queued')",
        "Job(**values)",
        "job.state = 'failed'",
        "session.execute(update(Job).where(Job.id == 1).values(state='failed'))",
        "update(JOBS).values(values)",
    ],
)
def test_a_module_that_wrote_it_would_be_found(code):
    assert list(writes(ast.parse(code)))


@pytest.fixture(scope="module")
def database(tmp_path_factory) -> Iterator[Database]:
    """A database that notes every state that a job goes through, whoever changes it."""
    asked = Settings(data_dir=tmp_path_factory.mktemp("transitions"))
    opened = Database(asked)
    upgrade(opened, asked)
    with opened.write() as session:
        session.execute(text("CREATE TABLE seen (job TEXT, old TEXT, new TEXT)"))
        note = "BEGIN INSERT INTO seen VALUES (new.id, old.state, new.state); END"
        session.execute(text(f"CREATE TRIGGER note AFTER UPDATE OF state ON job {note}"))
    yield opened
    opened.close()


class Play:
    """Jobs of one reprocessing and one alone, to which everything is done that the service does to jobs."""

    def __init__(self, database: Database) -> None:
        self.database, self.claims = database, {}
        with database.write() as session:
            for table in (OutboxEntry, Job):
                session.execute(delete(table))
            session.execute(text("DELETE FROM seen"))
            self.parent = self._add(session, new_job("reprocessing", 0, {}, "k", is_sum=True))
            children = [self._add(session, new_job("calibration", 0, {}, "k", parent_id=self.parent)) for _ in range(2)]
            self.jobs = [*children, self._add(session, new_job("calibration", 0, {}, "k"))]

    @staticmethod
    def _add(session, job: Job) -> str:
        session.add(job)
        session.flush()
        return job.id

    def do(self, what: str, number: int) -> None:
        job_id = self.jobs[number]
        try:
            with self.database.write() as session:
                self._do(session, what, job_id)
        except (LostClaimError, ConflictError):
            return

    def _do(self, session, what: str, job_id: str) -> None:
        if what.startswith("claim"):
            lease_s = LAPSED_S if what == "claim and die" else LONG_S
            claim = claim_one(session, job_id, "worker", lease_s, MOST_LOST)
            self.claims[job_id] = claim or self.claims.get(job_id)
        elif what == "cancel":
            JobRepository(session, SYSTEM).cancel(job_id)
        elif what == "cancel all":
            JobRepository(session, SYSTEM).cancel(self.parent)
        elif what == "bury":
            bury_lost(session, MOST_LOST, lapsed_by_clock())
        elif (claim := self.claims.get(job_id)) is None:
            return
        elif what == "hand back":
            hand_back(session, claim, is_lost=True)
        else:
            finish(session, claim, what)

    def seen(self) -> list[tuple[str, str, str]]:
        with self.database.read() as session:
            return [tuple(row) for row in session.execute(text("SELECT job, old, new FROM seen"))]

    def check(self) -> None:
        """What has ended has ended once, stays so, was told once, and is counted by what sums it up."""
        seen = self.seen()
        assert {(old, new) for _, old, new in seen} <= ALLOWED
        ends = Counter(job for job, _, new in seen if new in ENDED)
        with self.database.read() as session:
            told = Counter(str(row.data["job_id"]) for row in session.scalars(select(OutboxEntry)))
            states = dict(session.execute(select(Job.id, Job.state)).all())
            parent, counts = session.get_one(Job, self.parent), counts_of(session, self.parent)
        assert ends == told == Counter(job for job, state in states.items() if state in ENDED)
        is_over = set(counts) <= ENDED
        assert parent.state == "cancelled" or (parent.state == "succeeded") == is_over
        if parent.state == "succeeded":
            assert {state: count for state, count in parent.result.items() if count} == counts


STEPS = ("claim", "claim and die", "hand back", "succeeded", "failed", "cancelled", "cancel", "cancel all", "bury")


@settings(max_examples=25, derandomize=True, suppress_health_check=list(HealthCheck))
@given(steps=st.lists(st.tuples(st.sampled_from(STEPS), st.integers(0, 2)), max_size=12))
def test_whatever_is_done_no_other_transition_happens_and_every_end_is_told_once(database, steps):
    play = Play(database)
    for what, number in steps:
        play.do(what, number)
    play.check()


def test_every_transition_that_is_allowed_happens(database):
    ways = {
        ("queued", "running"): ["claim"],
        ("running", "running"): ["claim and die", "claim"],
        ("running", "queued"): ["claim", "hand back"],
        ("running", "succeeded"): ["claim", "succeeded"],
        ("running", "failed"): ["claim", "failed"],
        ("running", "cancelled"): ["claim", "cancel", "cancelled"],
        ("queued", "cancelled"): ["cancel"],
    }
    assert set(ways) == ALLOWED
    for (old, new), steps in ways.items():
        play = Play(database)
        for what in steps:
            play.do(what, 2)
        assert [(was, now) for job, was, now in play.seen() if job == play.jobs[2]][-1] == (old, new)
        play.check()


@pytest.mark.parametrize("state", ["queued", "running", "done"])
def test_an_attempt_ends_only_in_an_end(database, state):
    play = Play(database)
    play.do("claim", 0)
    with pytest.raises(TransitionError), database.write() as session:
        finish(session, play.claims[play.jobs[0]], state)
    with pytest.raises(TransitionError):
        transitions.claiming("failed", Job.id == "x", LONG_S)

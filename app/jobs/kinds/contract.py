"""What a kind of job is: the contract that the registry's entries fulfil."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.errors import ServiceError
from app.jobs.schemas import JobBody
from app.storage.store import Store


class WrongKindError(ServiceError):
    """A job was given to another kind than its own."""

    code = "internal"


@dataclass(frozen=True, slots=True)
class Admission:
    """What a request for a job comes down to, once everything that it names has been found.

    ``request`` is kept with the job and is all that `JobKind.load` needs; jobs with the same ``lock`` run one by one.
    """

    request: dict[str, object]
    satellite_id: str | None = None
    magnetometer_id: str | None = None
    session_ids: Sequence[str] = field(default=())
    lock: str | None = None


class JobKind(Protocol):
    """One kind of job.

    Attributes
    ----------
    body : type
        The request; its field ``kind`` is a literal with the kind's name.
    function : str
        ``module:function`` that calculates in the child: ``(work, report) -> Outcome``.
    warm : str
        ``module:function`` that a new child calls first, so that the first job finds everything loaded; "" for none.
    """

    body: type[JobBody]
    function: str
    warm: str

    def admit(self, session: Session, caller: Caller, body: JobBody) -> Admission:
        """Return what ``body`` asks for; raise where the caller does not reach it or it cannot be done."""
        ...

    def check(self, session: Session, admission: Admission) -> None:
        """Raise what would make the job fail for certain, so that the request is refused at once."""
        ...

    def load(self, session: Session, store: Store, claim: Claim) -> object:
        """Return what the calculation works on: plain data that goes to another process."""
        ...

    def keep(self, session: Session, store: Store, claim: Claim, found: Outcome) -> dict[str, object]:
        """Keep what was found in the transaction that ends the job, and return the job's ``result``."""
        ...


Report = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a calculation found: a document, and byte strings that go into the store."""

    record: dict[str, object]
    blobs: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Claim:
    """The right of one attempt to work on one job, and what of the job it needs for that."""

    job_id: str
    attempt: int
    kind: str
    lost_attempts: int
    satellite_id: str | None
    magnetometer_id: str | None
    request: dict[str, object]

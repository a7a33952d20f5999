"""The seam of the queue: what the service asks of it, whichever engine hands the jobs out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from sqlalchemy.orm import Session

from app.jobs.kernels import Kernels
from app.jobs.tables import Job


class Queue(Protocol):
    """Hands jobs to workers; a job is a row of the service's own table in every engine."""

    def enqueue(self, session: Session, jobs: Sequence[Job]) -> None:
        """Hand ``jobs`` out once the session's transaction is committed, and not if it is not.

        The jobs are new rows, or rows whose attempt has just been handed back.
        """
        ...

    def announce(self) -> None:
        """Tell workers at hand that a transaction with new jobs was committed, so that they need not poll."""
        ...

    def check(self) -> None:
        """Raise UnavailableError where jobs would not be handed out."""
        ...


class Workers(Protocol):
    """Job workers of one process; they take no job before their ``kernels`` are ready."""

    kernels: Kernels

    def start(self) -> None:
        """Begin to take jobs."""
        ...

    def stop(self, grace_s: float) -> None:
        """Take no more jobs; give those that run ``grace_s`` seconds, then hand them back."""
        ...

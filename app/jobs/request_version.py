"""Which jobs a worker understands: none whose request was written by a later release.

While releases are rolled out, a server may ask for what a worker of the release before does not know. Each job carries
the version of its request; a worker claims those up to its own, and the others wait for one that knows them. On
PostgreSQL each version has a queue of its own, which workers of earlier releases do not listen to.
"""

from __future__ import annotations

from typing import Final

from sqlalchemy import ColumnElement

from app.jobs.tables import Job

REQUEST_VERSION: Final = 2
"""Raised where a request may say what the release before does not know: a kind, an option, a value of one."""


def queue_of(version: int) -> str:
    """Return the queue on PostgreSQL of the jobs of a version."""
    return "magcal" if version == 1 else f"magcal-{version}"


QUEUES: Final = tuple(queue_of(version) for version in range(1, REQUEST_VERSION + 1))
"""What a worker listens to."""


def is_understood() -> ColumnElement[bool]:
    """Return the condition that tells the jobs that this release understands."""
    return Job.metadata.tables["job"].c.request_version <= REQUEST_VERSION

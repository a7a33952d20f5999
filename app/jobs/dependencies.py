"""What an endpoint asks of the jobs: the queue that a new job goes into."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Request

from app.http.services import services_of
from app.jobs.queue import Queue


@dataclass(frozen=True, kw_only=True)
class JobServices:
    """What the jobs add to what the application holds."""

    queue: Queue


async def _queue(request: Request) -> Queue:
    return services_of(request.app, JobServices).queue


Jobs = Annotated[Queue, Depends(_queue)]

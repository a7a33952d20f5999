"""What an endpoint asks of the jobs: the queue that a new job goes into."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from app.jobs.queue import Queue


async def _queue(request: Request) -> Queue:
    queue: Queue = request.app.state.queue
    return queue


Jobs = Annotated[Queue, Depends(_queue)]

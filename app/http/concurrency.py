"""Places for calculations inside a request: so many at once in this process, and whoever waits too long is told so."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from app.errors import BusyError

AT_ONCE: Final = 2
WAIT_S: Final = 20.0


class Places:
    """Places for calculations of one kind, named in the plural for whoever finds none free."""

    def __init__(self, kind: str, *, at_once: int = AT_ONCE, wait_s: float = WAIT_S) -> None:
        self._kind = kind
        self._wait_s = wait_s
        self._free = threading.BoundedSemaphore(at_once)

    @contextmanager
    def one(self) -> Iterator[None]:
        """Hold a place for the block.

        Raises
        ------
        BusyError
            None became free in time.
        """
        if not self._free.acquire(timeout=self._wait_s):
            raise BusyError(f"as many {self._kind} run as may run at once; try again")
        try:
            yield
        finally:
            self._free.release()

"""Calculations that go wrong, planted in the child in place of a calibration.

A name may end with how many seconds it takes: `slow_8`.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from functools import partial

from app.jobs.kinds.calibration_child import calibrate
from app.jobs.kinds.contract import Outcome, Report


def __getattr__(name: str) -> Callable[[object, Report], Outcome]:
    calculation, _, seconds = name.partition("_")
    if calculation != "slow" or not seconds:
        raise AttributeError(name)
    return partial(slow, float(seconds))


def slow(seconds: float, work: object, report: Report) -> Outcome:
    """A calibration that takes so much longer."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(0.02)
        report(0.1)
    return calibrate(work, report)


def crash(work: object, report: Report) -> Outcome:
    """A calculation that ends its process."""
    os.kill(os.getpid(), signal.SIGSEGV)
    return calibrate(work, report)


def hoard(work: object, report: Report) -> Outcome:
    """A calculation that wants all the memory there is."""
    kept = []
    while True:
        kept.append(bytearray(1 << 26))
        report(0.1)


def hang(work: object, report: Report) -> Outcome:
    """A calculation that never ends, and holds the interpreter while it does not."""
    while True:
        sum(range(10_000_000))


def stumble(work: object, report: Report) -> Outcome:
    """A calculation with a mistake in it."""
    raise ZeroDivisionError("planted")

"""Columns that say nothing of the sensor, and one that does: how often `regressors: auto` takes which.

Sessions on missions drawn anew, with a slow error of the bias that no column explains: a wave, unseen heat of the
orbit, a walk, a memory of minutes, or none. Decoys are what operations files hold: random walks, housekeeping that
follows the orbit, currents that switch. ``MAGCAL_DECOYS`` sets the number of sessions of each kind,
``MAGCAL_SEEDS_FROM`` the number that their seeds begin at.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Final

import numpy as np

from benchmarks.measure import Figure
from magcal_core.errors import MagcalError
from magcal_core.pipeline import calibrate
from magcal_core.sensor.regressors import lag_of
from tests.magcal_core.decoys import ERRORS, FULL_TABLE, Session, draw

IS_STUDY = True
ROOM: Final = "decoys"
SESSIONS: Final = 24


def taken(session: Session) -> tuple[str, ...] | None:
    """Return the columns that `auto` takes, without their lags; None where there is no calibration."""
    try:
        found = calibrate(session.flown.sent(), [session.flown.orbit], regressors="auto")
    except MagcalError:
        return None
    return tuple(lag_of(name)[0] for name in found.parameters.regressors)


def figures() -> Iterator[Figure]:
    """Yield how often a decoy is taken where no column, or one, moves the bias, and how often that one is found."""
    sessions = int(os.environ.get("MAGCAL_DECOYS", SESSIONS))
    begin = int(os.environ.get("MAGCAL_SEEDS_FROM", "0"))
    seeds = range(begin, begin + sessions)
    false, detected, every = [], [], 0
    for error in ERRORS:
        for true in ("", "temperature", "torquer"):
            got = [(one, taken(one)) for one in (draw(seed, error, true) for seed in seeds)]
            known = [(one, names) for one, names in got if names is not None]
            every += len(known)
            wrong = [any(name != one.true for name in names) for one, names in known]
            right = [one.true in names for one, names in known]
            false += wrong if not true else []
            detected += right if true else []
            what = f"{error} error, {true or 'no column'}"
            share = 100.0 * float(np.mean(wrong))
            note = f"{len(known)} sessions" + (
                f"; the column found in {100 * float(np.mean(right)):.0f} %" if true else ""
            )
            yield Figure(ROOM, f"{what}: with a decoy", share, "%", "", None, note)
    rate, found = 100.0 * float(np.mean(false)), 100.0 * float(np.mean(detected))
    yield Figure(
        ROOM, "no column moves the bias: with a decoy", rate, "%", "<= 5", rate <= 5.0, f"{len(false)} sessions"
    )
    yield Figure(
        ROOM, "the column that moves it is taken", found, "%", ">= 90", found >= 90.0, f"{len(detected)} sessions"
    )
    full = [taken(draw(seed, "wave", "", columns=FULL_TABLE)) for seed in seeds]
    rate = 100.0 * float(np.mean([bool(names) for names in full if names is not None]))
    yield Figure(
        ROOM, f"{FULL_TABLE} columns, wave: with a decoy", rate, "%", "<= 5", rate <= 5.0, f"{len(full)} sessions"
    )

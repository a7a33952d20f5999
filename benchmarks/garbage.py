"""Sessions with garbage of every kind on missions drawn anew: how many are calibrated as if it were not there.

A session counts where the same one without garbage is within `TWIN` of the field: what noise and motion leave is no
matter of garbage. ``MAGCAL_GARBAGE`` sets the number of missions of each kind, share and method, ``MAGCAL_SEEDS_FROM``
the number that their seeds begin at.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from benchmarks.measure import Figure
from magcal_core.calibration.result import Calibration
from magcal_core.errors import MagcalError
from magcal_core.pipeline import calibrate
from tests.magcal_core.fresh import Flown, fresh
from tests.magcal_core.garbage import KINDS, SCREENED, spoiled

IS_STUDY = True
ROOM: Final = "garbage"
MISSIONS: Final = 6
SHARES: Final = (0.003, 0.01, 0.05, 0.1, 0.2, 0.3)
METHODS: Final = ("scalar", "vector")
FIELD_NT: Final = 35000.0
WITHIN: Final = 0.005
"""Share of |B| that the corrected field may be off in the worst direction."""
TWIN: Final = 0.003
FAR: Final = 6.0
"""Times the noise from which on a row that the loss must find is bad."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one session ended: its error, its grade, the bad rows that are kept out and the good ones that are lost."""

    error: float
    grade: str
    kept_out: float
    lost: float

    @property
    def is_right(self) -> bool:
        """Whether there is a number, and it is right."""
        return self.error <= WITHIN and self.grade != "refuse"


def worst_error(found: Calibration, flown: Flown, *, is_vector: bool) -> float:
    """Return the largest error of the corrected field over all directions, as a share of it."""
    u = np.random.default_rng(0).normal(size=(300, 3))
    b_nt = FIELD_NT * u / np.linalg.norm(u, axis=1, keepdims=True)
    x = (flown.sensor.apply(b_nt) - found.parameters.bias_nt) @ found.correction_matrix.T
    off = np.linalg.norm(x - b_nt, axis=1) if is_vector else np.abs(np.linalg.norm(x, axis=1) - FIELD_NT)
    return float(off.max()) / FIELD_NT


def outcome(flown: Flown, kind: str, share: float, method: str, seed: int) -> Outcome | None:
    """Return how a session with a ``share`` of one kind ends; None where it is no good without garbage either."""
    is_vector = method == "vector"
    samples, is_bad = spoiled(flown, kind, share, seed)
    try:
        found = calibrate(flown.sent(samples, is_vector=is_vector), [flown.orbit], method=method)
    except MagcalError as error:
        return Outcome(np.inf, f"{error.code}: {error.message}"[:90], 0.0, 0.0) if _is_good(flown, method) else None
    off = worst_error(found, flown, is_vector=is_vector)
    if (off > WITHIN or found.verdict.grade == "refuse") and not _is_good(flown, method):
        return None
    x = (samples.h_nt - flown.sensor.bias_nt) @ flown.sensor.correction_matrix.T
    length_nt = np.abs(np.linalg.norm(x, axis=1) - samples.b_ref_magnitude_nt)
    off_nt = length_nt
    if is_vector:
        assert samples.b_ref_base_nt is not None
        off_nt = np.linalg.norm(x - samples.b_ref_base_nt, axis=1)
    # A loss sees a row only where it is far from what it should be; a screen sees all of its kinds.
    seen = is_bad & (off_nt > FAR * 1.2 * flown.noise_nt)
    weight = found.residuals.weight
    out = float(np.mean(weight[seen] == 0)) if seen.any() else 1.0
    return Outcome(off, found.verdict.grade, out, float(np.mean(weight[~is_bad] == 0)))


def _is_good(flown: Flown, method: str) -> bool:
    """Return whether the session is calibrated well without garbage; asked only where it is not with it."""
    is_vector = method == "vector"
    try:
        clean = calibrate(flown.sent(is_vector=is_vector), [flown.orbit], method=method)
    except MagcalError:
        return False
    return worst_error(clean, flown, is_vector=is_vector) <= TWIN and clean.verdict.grade != "refuse"


def figures() -> Iterator[Figure]:
    """Yield, of every kind and method over all shares, the sessions that are right, and the wrong ones accepted."""
    missions = int(os.environ.get("MAGCAL_GARBAGE", MISSIONS))
    first = int(os.environ.get("MAGCAL_SEEDS_FROM", "0"))
    for method in METHODS:
        every: list[Outcome] = []
        for number, kind in enumerate(KINDS):
            found = []
            for i, share in enumerate(SHARES):
                for trial in range(missions):
                    seed = first + 1000 * number + 100 * i + trial
                    one = outcome(fresh(seed), kind, share, method, seed)
                    if one is not None:
                        found.append(one)
            if not found:
                continue
            every += found
            yield from _of_kind(f"{method}, {kind}", kind, found)
        if every:
            right = 100.0 * float(np.mean([one.is_right for one in every]))
            wrong = sum(one.grade == "accept" and one.error > WITHIN for one in every)
            what = f"{method}, all kinds: within 0.5 % of |B|"
            yield Figure(ROOM, what, right, "%", ">= 99", right >= 99.0, f"{len(every)} sessions")
            yield Figure(ROOM, f"{method}, all kinds: wrong and accepted", wrong, "", "0", wrong == 0)


def _of_kind(what: str, kind: str, found: list[Outcome]) -> Iterator[Figure]:
    right = 100.0 * float(np.mean([one.is_right for one in found]))
    given = [one for one in found if np.isfinite(one.error)]
    out = 100.0 * float(np.mean([one.kept_out for one in given])) if given else 0.0
    lost = 100.0 * float(np.mean([one.lost for one in given])) if given else 0.0
    misses = "; ".join(f"{one.grade} {100 * one.error:.2g} %" for one in found if not one.is_right)
    enough = 85.0 if kind == "axis stuck" else 95.0
    screened = ", screened" if kind in SCREENED else ""
    note = f"{len(found)} sessions; bad rows out {out:.1f} %{screened}, good ones lost {lost:.2f} %; {misses}"
    is_met = right >= 99.0 and out >= enough and lost <= 1.0
    yield Figure(ROOM, f"{what}: within 0.5 % of |B|", right, "%", ">= 99", is_met, note)

"""Simulated missions of every kind through the pipeline, the worst kind first: do intervals cover, do verdicts err?

``MAGCAL_POPULATION`` sets the number of missions of each kind, ``MAGCAL_POPULATION_MINUTES`` the limit of time, which
cuts all kinds alike, ``MAGCAL_SEEDS_FROM`` the number that seeds begin at: without it one that is drawn anew, so that
no two runs see the same missions.
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks.external import rc_index
from benchmarks.measure import Figure
from magcal_core.simulation.kinds import KIND_NAMES, draw_kind
from magcal_core.simulation.population import TOLERANCE, Outcome, Rates, by_kind, rates_of, run_mission

IS_STUDY = True
ROOM = "population"
MISSIONS = 40
MINUTES = 50.0


def figures() -> Iterator[Figure]:
    """Yield coverage and error rates of every kind, the worst one first, and of all."""
    begin, count = time.monotonic(), int(os.environ.get("MAGCAL_POPULATION", MISSIONS))
    first = int(os.environ.get("MAGCAL_SEEDS_FROM") or secrets.randbelow(10**9))
    outcomes, wanted = run(range(first, first + count)), count * len(KIND_NAMES)
    yield Figure(
        ROOM, "missions", len(outcomes), "", f">= {wanted}", len(outcomes) >= wanted, f"MAGCAL_SEEDS_FROM={first}"
    )
    yield Figure(ROOM, "time", (time.monotonic() - begin) / 60.0, "min")
    for kind, rates in by_kind(outcomes):
        if not rates.estimates:
            refused = 100 * rates.refused / rates.missions
            yield Figure(ROOM, f"{kind}: refused, no estimate", refused, "%", "", None, _note(rates))
            continue
        is_met = rates.coverage >= 0.80
        yield Figure(ROOM, f"{kind}: coverage", 100 * rates.coverage, "%", ">= 80", is_met, _note(rates))
    yield from _of_all(outcomes)


def _note(rates: Rates) -> str:
    return (
        f"{rates.missions} missions: {rates.accepted} accepted ({rates.bad_accepted} bad), {rates.weak} weak, "
        f"{rates.refused} refused; {rates.good_refused} of {rates.good} good ones refused; "
        f"d' C^-1 d {rates.distance_median:.2g} in the median, {rates.distance_mean:.2g} in the mean"
    )


def _of_all(outcomes: Sequence[Outcome]) -> Iterator[Figure]:
    rates = rates_of(outcomes)
    for what, value in (("all estimates", rates.coverage), ("accepted estimates", rates.coverage_accepted)):
        is_met = 0.90 <= value <= 0.995
        yield Figure(ROOM, f"coverage of 95 % intervals, {what}", 100 * value, "%", "90 to 99.5", is_met, _note(rates))
    bad, is_few = 100 * rates.bad_among_accepted, rates.bad_among_accepted <= 0.01
    yield Figure(ROOM, "bad among accepted", bad, "%", "<= 1", is_few, f"good: error <= {TOLERANCE:.0%} of the field")
    missed = rates.good_refused / max(rates.good, 1)
    yield Figure(ROOM, "good that were refused", 100 * missed, "%", "<= 10", missed <= 0.10)
    odd = [one.is_mean_covered for one in outcomes if one.is_mean_covered is not None]
    if odd:
        what = "one light left out: intervals of the bias that hold its mean over all the session"
        yield Figure(ROOM, what, 100 * float(np.mean(odd)), "%", "", None, f"{len(odd)} missions")


def run(seeds: Sequence[int]) -> list[Outcome]:
    """Return the outcomes of as many missions as the limit of time lets through: seed by seed, every kind of each."""
    deadline = time.monotonic() + 60.0 * float(os.environ.get("MAGCAL_POPULATION_MINUTES", MINUTES))
    workers = len(os.sched_getaffinity(0))
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for start in range(0, len(seeds), workers):
            if time.monotonic() > deadline:
                break
            todo = [(kind, seed) for seed in seeds[start : start + workers] for kind in KIND_NAMES]
            outcomes += pool.map(_outcome, *zip(*todo, strict=True), chunksize=4)
    return outcomes


def _outcome(kind: str, seed: int) -> Outcome:
    return run_mission(draw_kind(kind, seed, rc_index()))

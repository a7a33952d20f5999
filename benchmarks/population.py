"""Two thousand simulated missions of all kinds through the pipeline: do intervals cover, do verdicts err?

``MAGCAL_POPULATION`` sets another number of missions, ``MAGCAL_POPULATION_MINUTES`` another limit of time.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

from benchmarks.measure import Figure
from magcal_core.simulation.missions import draw_mission
from magcal_core.simulation.population import TOLERANCE, Outcome, rates_of, run_mission

IS_STUDY = True
MISSIONS = 2000
MINUTES = 40.0
FIRST_SEED = 10_000
_BATCH = 20


def figures() -> Iterator[Figure]:
    """Yield coverage and error rates."""
    begin = time.monotonic()
    outcomes = run()
    rates, minutes = rates_of(outcomes), (time.monotonic() - begin) / 60.0
    wanted = int(os.environ.get("MAGCAL_POPULATION", MISSIONS))
    note = f"{rates.accepted} accepted, {rates.weak} weak, {rates.refused} refused; {rates.good} good"

    def figure(
        what: str, value: float, unit: str, aim: str = "", *, is_met: bool | None = None, note: str = ""
    ) -> Figure:
        return Figure("population", what, value, unit, aim, is_met, note)

    yield figure("missions", rates.missions, "", f">= {wanted}", is_met=rates.missions >= wanted, note=note)
    yield figure("time", minutes, "min")
    for what, value in (("all estimates", rates.coverage), ("accepted estimates", rates.coverage_accepted)):
        is_met = 0.90 <= value <= 0.98
        yield figure(f"coverage of 95 % intervals, {what}", 100 * value, "%", "90 to 98", is_met=is_met)
    good = f"good: error <= {TOLERANCE:.0%} of the field"
    yield figure(
        "bad among accepted",
        100 * rates.bad_among_accepted,
        "%",
        "<= 1",
        is_met=rates.bad_among_accepted <= 0.01,
        note=good,
    )
    yield figure("bad that were accepted", 100 * rates.accepted_bad, "%", "<= 2", is_met=rates.accepted_bad <= 0.02)
    yield figure("good that were refused", 100 * rates.refused_good, "%", "<= 10", is_met=rates.refused_good <= 0.10)


def run() -> list[Outcome]:
    """Return the outcomes of as many missions as the limit of time lets through, in batches of seeds in order."""
    count = int(os.environ.get("MAGCAL_POPULATION", MISSIONS))
    deadline = time.monotonic() + 60.0 * float(os.environ.get("MAGCAL_POPULATION_MINUTES", MINUTES))
    workers = len(os.sched_getaffinity(0))
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        seeds = list(range(FIRST_SEED, FIRST_SEED + count))
        for start in range(0, count, _BATCH * workers):
            if time.monotonic() > deadline:
                break
            outcomes += pool.map(_outcome, seeds[start : start + _BATCH * workers], chunksize=_BATCH // 4)
    return outcomes


def _outcome(seed: int) -> Outcome:
    return run_mission(draw_mission(seed))

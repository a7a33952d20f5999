"""Parameters in time, counted over simulated histories and sessions: forecasts, coverage, steps that are named.

``MAGCAL_MOVING_BIAS`` sets another number of histories and of sessions a kind.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.measure import Figure
from magcal_core.calibration.sessions.trend import Trend, trend
from magcal_core.calibration.terms.bias_path import BiasPath, bias_path
from magcal_core.calibration.terms.bias_steps import bias_steps
from magcal_core.pipeline import calibrate
from tests.magcal_core.calibration.moving_bias import SENSOR, memory_nt, session, step_nt, time_of
from tests.magcal_core.calibration.sessions.histories import Simulated, history, nine

IS_STUDY = True
ROOM = "moving_bias"
COUNT = int(os.environ.get("MAGCAL_MOVING_BIAS", "60"))

HISTORIES: dict[str, Callable[[int], Simulated]] = {
    "constant, 6 sets": lambda seed: history(seed, 6, walk_nt=0.0),
    "walk of 120 nT a root year, 12 sets": lambda seed: history(seed, 12),
    "walk of 800 nT a root year, 5 sets": lambda seed: history(seed, 5, walk_nt=800.0),
    "jump of 600 nT, 12 sets": lambda seed: history(seed, 12, walk_nt=0.0, jump=(6, (490.0, -300.0, 170.0))),
}


def figures() -> Iterator[Figure]:
    """Yield the figures of histories, then those of sessions."""
    for name, made in HISTORIES.items():
        yield from _histories(name, made)
    for method in ("scalar", "vector"):
        yield from _sessions(method)


def _figure(what: str, value: float, unit: str, aim: str = "", *, is_met: bool | None = None) -> Figure:
    return Figure(ROOM, what, value, unit, aim, is_met)


def _histories(name: str, made: Callable[[int], Simulated]) -> Iterator[Figure]:
    errors: dict[str, list[float]] = {"trend": [], "last set": [], "mean": [], "line": []}
    held, bound, false = [], [], 0
    for seed in range(COUNT):
        one = made(50_000 + seed)
        found = trend(one.sets, at=one.at)
        now = found.at(one.at)
        values = np.array([nine(each["parameters"]) for each in one.sets])
        times = np.array([each.time_ns for each in found.chosen.every], np.float64) / 3.15576e16
        at = float(one.at.astype("datetime64[ns]").astype(np.int64)) / 3.15576e16
        guesses = {"trend": now.parameters, "last set": values[-1], "mean": values.mean(axis=0)}
        guesses["line"] = np.array([np.polyval(np.polyfit(times - at, column, 1), 0.0) for column in values.T])
        for rule, guess in guesses.items():
            errors[rule].append(_field_error_nt(found, guess - one.truth))
        held.append(np.abs(now.parameters - one.truth) < 1.96 * now.standard_errors)
        bound.append(errors["trend"][-1] < float(now.field_error_nt))
        false += len(found.left_out) + (0 if "jump" in name else len(found.jumps))
    for rule, all_of_it in errors.items():
        yield _figure(f"{name}: field error of the {rule}, rms", float(np.sqrt(np.mean(np.square(all_of_it)))), "nT")
    share = 100 * float(np.mean(held))
    yield _figure(f"{name}: 95 % intervals that hold", share, "%", ">= 87", is_met=share >= 87)
    yield _figure(f"{name}: bounds of the field that hold", 100 * float(np.mean(bound)), "%")
    yield _figure(
        f"{name}: false jumps and outliers a history", false / COUNT, "", "<= 0.05", is_met=false / COUNT <= 0.05
    )


def _field_error_nt(found: Trend, away: np.ndarray) -> float:
    share = away / found.smoothed.unit
    return float(np.sqrt(share @ found.smoothed.metric @ share))


def _sessions(method: str) -> Iterator[Figure]:
    steps = {"200 nT": 200.0, "500 nT": 500.0}
    for name, size in steps.items():
        named, timed, sized, paths = 0, [], [], []
        for seed in range(COUNT):
            share = 0.25 + 0.5 * (seed % 17) / 16.0
            change = size * np.array([0.74, -0.53, 0.42])
            plain = session(seed)
            moved = step_nt(plain, share, tuple(change))
            moments = calibrate(session(seed, moved), method=method, bias_steps="none", with_moments=True).moments
            if moments is None:
                continue
            found = bias_steps(moments).items
            named += len(found) == 1
            paths.append(_path_errors(bias_path(moments), moved))
            if len(found) == 1:
                timed.append(abs(float((found[0].time - time_of(plain, share)) / np.timedelta64(1, "s"))))
                sized.append(float(np.abs(found[0].change_nt - change).max()))
        yield _figure(f"{method}, 3 h: a step of {name} is named", 100 * named / COUNT, "%")
        yield _figure(f"{method}, 3 h: error of its time, median", float(np.median(timed)), "s")
        yield _figure(f"{method}, 3 h: largest error of its size, median", float(np.median(sized)), "nT")
        still, path = np.sqrt(np.mean(np.square(paths), axis=0))
        yield _figure(f"{method}, 3 h, step of {name}: error of one bias, rms", float(still), "nT")
        yield _figure(f"{method}, 3 h, step of {name}: error of the path, rms", float(path), "nT")
    kinds = {"no step": 0.0, "no step, memory of 15 min, 100 nT": 900.0, "no step, memory of 90 min, 100 nT": 5400.0}
    for name, memory_s in kinds.items():
        false = 0
        for seed in range(COUNT):
            memory = None if memory_s == 0.0 else memory_nt(seed, session(seed), 100.0, memory_s)
            moments = calibrate(session(seed, memory), method=method, bias_steps="none", with_moments=True).moments
            false += moments is not None and bool(bias_steps(moments).items)
        yield _figure(
            f"{method}, 3 h, {name}: false steps", 100 * false / COUNT, "%", "<= 2", is_met=false <= 0.02 * COUNT
        )


def _path_errors(path: BiasPath, moved: np.ndarray) -> tuple[float, float]:
    """Return the rms error of one bias for all of a session, and of the path, nT."""
    at = np.linspace(0, len(moved) - 1, len(path.t_utc)).astype(np.intp)
    truth = SENSOR.bias_nt + moved[at]
    return (
        float(np.sqrt(np.mean((path.own_bias_nt - truth) ** 2))),
        float(np.sqrt(np.mean((path.bias_nt - truth) ** 2))),
    )

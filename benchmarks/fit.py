"""The fits against scipy and against the paper's search in plain Python, side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.measure import Figure, interleaved_s
from magcal_core.calibration.estimators.contract import FitSettings
from magcal_core.calibration.estimators.hooke_jeeves import hooke_jeeves
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.observations import Observations
from magcal_core.samples import Samples
from magcal_core.sensor.conventions import first_order_a
from magcal_core.sensor.model import SensorModel

Floats = NDArray[np.float64]

SENSOR = SensorModel(
    np.array([2928.125, -1191.25, -1875.625]),
    np.array([1.032695, 1.006685, 1.032875]),
    np.array([-4.53, -1.067, 7.915]),
)
START = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def telemetry(n: int, outliers: float = 0.02) -> Samples:
    """Return ``n`` samples of a tumbling sensor with 100 nT of noise and some spikes, the field beside them."""
    random = np.random.default_rng(n)
    turn = np.deg2rad(0.76) * 10.0 * np.arange(n)
    slow = 0.41 * turn
    u = np.c_[np.cos(turn) * np.cos(slow), np.sin(turn) * np.cos(slow), np.sin(slow)]
    b_nt = u * (23000.0 * np.sqrt(1 + 2.9 * np.sin(turn / 12.0) ** 2))[:, None]
    h_nt = SENSOR.apply(b_nt) + 100.0 * random.normal(size=(n, 3))
    struck = random.random(n) < outliers
    h_nt[struck, 0] += random.uniform(3000, 25000, np.count_nonzero(struck))
    t_utc = np.datetime64("2022-02-19T22:37:44", "ns") + np.arange(n) * np.timedelta64(10, "s")
    return Samples(t_utc, h_nt, b_ref_base_nt=b_nt, b_ref_magnitude_nt=np.linalg.norm(b_nt, axis=1))


def scipy_soft_l1(h: Floats, b: Floats) -> Floats:
    """Return (L, L b) by scipy's trust-region fit with soft L1 and the analytic Jacobian: the peer."""
    rows, columns = np.tril_indices(3)

    def corrected(theta: Floats) -> Floats:
        lower = np.zeros((3, 3))
        lower[rows, columns] = theta[:6]
        return np.asarray(h @ lower.T - theta[6:])

    def residual(theta: Floats) -> Floats:
        return np.asarray(np.linalg.norm(corrected(theta), axis=1) - b)

    def jacobian(theta: Floats) -> Floats:
        x = corrected(theta)
        u = x / np.linalg.norm(x, axis=1)[:, None]
        return np.column_stack([u[:, rows] * h[:, columns], -u])

    start = np.concatenate([np.eye(3)[rows, columns], np.zeros(3)])
    scale = np.concatenate([np.ones(6), np.full(3, 4e4)])
    found = least_squares(residual, start, jacobian, loss="soft_l1", f_scale=135.0, x_scale=scale, method="trf")
    return np.asarray(found.x)


def python_cost(h: Sequence[Sequence[float]], b: Sequence[float], p: Sequence[float]) -> float:
    """Return the paper's cost at first-order parameters, one sample after the other."""
    a = first_order_a(np.array(p[:3]), np.array(p[3:6])).tolist()
    total = 0.0
    for reading, field in zip(h, b, strict=True):
        d = [reading[i] - p[6 + i] for i in range(3)]
        square = sum(d[i] * a[i][j] * d[j] for i in range(3) for j in range(3))
        total += (math.sqrt(max(square, 0.0)) - field) ** 2
    return total


def python_hooke_jeeves(h: Sequence[Sequence[float]], b: Sequence[float], evaluations: int) -> int:
    """Run the paper's search in plain Python for ``evaluations`` evaluations; return how many it took."""
    p, step, spent = START.tolist(), [0.02] * 6 + [800.0] * 3, 1
    best = python_cost(h, b, p)
    while spent < evaluations:
        is_better = False
        for i in range(9):
            for sign in (1.0, -2.0):
                p[i] += sign * step[i]
                cost = python_cost(h, b, p)
                spent += 1
                if cost < best:
                    best, is_better = cost, True
                    break
            else:
                p[i] += step[i]
        if not is_better:
            step = [size / 2 for size in step]
    return spent


def compiled_hooke_jeeves(h: Floats, b: Floats, evaluations: int) -> int:
    """Run the compiled search for about ``evaluations`` evaluations; return how many it took."""
    step = np.array([0.02] * 6 + [800.0] * 3)
    _, spent = hooke_jeeves(h, b, np.ones(len(b)), START.copy(), step, 1e-9, evaluations, -1.0)
    return int(spent)


def figures() -> Iterator[Figure]:
    """Yield the fits' speed against peers."""
    for n, aim in ((100_000, 4.0), (1_000_000, 8.0)):
        observations = Observations.of(telemetry(n))
        fit = partial(ESTIMATORS["scalar"].fit, observations, FitSettings("soft_l1"))
        peer = partial(scipy_soft_l1, observations.h_nt, observations.b_nt)
        times = interleaved_s({"ours": fit, "scipy": peer}, rounds=3)
        ratio = times["scipy"] / times["ours"]
        note = f"{1e3 * times['ours']:.0f} ms, scipy {1e3 * times['scipy']:.0f} ms; scale, errors, checks included"
        yield Figure("fit", f"robust fit, {n:.0e} samples, over scipy", ratio, "x", f">= {aim:g}", ratio >= aim, note)
    yield _search()


def _search() -> Figure:
    observations = Observations.of(telemetry(700, 0.0))
    h, b = observations.h_nt.tolist(), observations.b_nt.tolist()
    spent = {
        "plain": python_hooke_jeeves(h, b, 60),
        "compiled": compiled_hooke_jeeves(observations.h_nt, observations.b_nt, 2000),
    }
    times = interleaved_s(
        {
            "plain": partial(python_hooke_jeeves, h, b, 60),
            "compiled": partial(compiled_hooke_jeeves, observations.h_nt, observations.b_nt, 2000),
        },
        rounds=5,
    )
    ratio = (times["plain"] / spent["plain"]) / (times["compiled"] / spent["compiled"])
    note = f"{1e6 * times['compiled'] / spent['compiled']:.1f} us an evaluation"
    return Figure("fit", "Hooke-Jeeves, 700 samples, over plain Python", ratio, "x", ">= 300", ratio >= 300, note)

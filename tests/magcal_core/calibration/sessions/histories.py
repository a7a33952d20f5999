"""Simulated histories of parameter sets: a walk, jumps and bad sets that are known, with the state they came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GROUPS = ("bias_nt", "scale", "nonorthogonality_deg")
BASE = np.array([1200.0, -800.0, 500.0, 1.05, 0.97, 1.02, 0.8, -0.5, 0.4])
UNIT = np.array([40_000.0] * 3 + [1.05, 0.97, 1.02] + [180.0 / np.pi] * 3)
START = np.datetime64("2024-01-01", "us")


@dataclass(frozen=True)
class Simulated:
    """Parameter sets, and the true parameters ``ahead`` days past the last one, at ``at``."""

    sets: list[dict]
    truth: np.ndarray
    at: np.datetime64


def history(  # noqa: PLR0917
    seed: int,
    count: int,
    walk_nt: float = 120.0,
    jump: tuple[int, tuple[float, float, float]] | None = None,
    alone: tuple[int, float] | None = None,
    years: float = 2.0,
    ahead_days: float = 30.0,
    noise_nt: tuple[float, float] = (10.0, 40.0),
) -> Simulated:
    """Return a history of ``count`` sets over ``years``; scale and angles walk a third as much as the bias.

    ``jump``: first set after it, and the change of the bias, nT; ``alone``: a set that is off by so much, nT.
    """
    rng = np.random.default_rng(seed)
    t = np.concatenate([[0.0], np.sort(rng.uniform(0.02 * years, years, count - 1))])
    walk = np.array([walk_nt / 40_000.0] * 3 + [walk_nt / 120_000.0] * 6)
    state, sets = np.zeros(9), []
    for i in range(count):
        if i:
            state = state + rng.normal(size=9) * walk * np.sqrt(t[i] - t[i - 1])
        if jump is not None and i == jump[0]:
            state[:3] += np.array(jump[1]) / 40_000.0
        one = record(rng, i, t[i], BASE + state * UNIT, float(rng.uniform(*noise_nt)))
        if alone is not None and i == alone[0]:
            one["parameters"]["bias_nt"][0] += alone[1]
        sets.append(one)
    sets[-1]["status"] = "active"
    ahead = ahead_days / 365.25
    state = state + rng.normal(size=9) * walk * np.sqrt(ahead)
    return Simulated(sets, BASE + state * UNIT, time_of(t[-1] + ahead))


def record(rng: np.random.Generator, number: int, years: float, truth: np.ndarray, noise_nt: float) -> dict:
    """Return a parameter set of three hours around a time, with correlated errors of a known covariance."""
    mixed = 0.3 * rng.normal(size=(9, 9)) + np.eye(9)
    covariance = mixed @ mixed.T
    sizes = noise_nt * np.concatenate([np.ones(3), UNIT[3:] / 40_000.0]) / np.sqrt(np.diag(covariance))
    covariance *= np.outer(sizes, sizes)
    values = truth + np.linalg.cholesky(covariance) @ rng.normal(size=9)
    middle = time_of(years)
    return {
        "id": f"set-{number:03d}",
        "satellite": "sim",
        "magnetometer": "mgm",
        "status": "retired",
        "verdict": {"grade": "accept", "reasons": []},
        "data_from": f"{middle - np.timedelta64(90, 'm')}Z",
        "data_until": f"{middle + np.timedelta64(90, 'm')}Z",
        "method": "scalar",
        "parameters": in_groups(values) | {"time_offset_s": None, "regressors": {}},
        "standard_errors": in_groups(np.sqrt(np.diag(covariance))) | {"time_offset_s": None, "regressors": {}},
        "parameter_names": [f"{group}[{i}]" for group in GROUPS for i in range(3)],
        "covariance": covariance.tolist(),
        "statistics": {"after": {"rms_nt": 100.0}},
    }


def time_of(years: float) -> np.datetime64:
    """Return a time so many years after the first set."""
    return START + np.timedelta64(round(years * 365.25 * 86400e6), "us")


def in_groups(values: np.ndarray) -> dict:
    """Return nine values as a record has them."""
    return {group: values[3 * i : 3 * i + 3].tolist() for i, group in enumerate(GROUPS)}


def nine(groups: dict) -> np.ndarray:
    """Return the nine values of a record's parameters."""
    return np.array([value for group in GROUPS for value in groups[group]])

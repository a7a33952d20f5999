"""The numerical orbit: its speed once compiled, and how far it is from the worked case."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import Figure, interleaved_s
from magcal_core.orbit.propagators.numerical import NumericalOrbit

EPOCH = np.datetime64("2022-02-19T22:37:44.130", "ns")
R_KM = (6861.897826, -934.3811016, -14.66851920)
V_KM_S = (-0.1222573311, -1.009655310, 7.525523775)
CASE = Path(__file__).resolve().parent.parent / "tests" / "data" / "orbit" / "dekart1.csv"


def _propagate(hours: float, step_s: int, **forces: object) -> np.ndarray:
    t_utc = EPOCH + np.arange(0, hours * 3600 + 1, step_s).astype("timedelta64[s]")
    return NumericalOrbit(EPOCH, R_KM, V_KM_S, **forces).state_gcrf(t_utc)[0]  # type: ignore[arg-type]


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    aims_ms = {
        "3 h, 12x12, Sun, Moon, every 10 s": (lambda: _propagate(3, 10), 10.0),
        "24 h, 12x12, Sun, Moon, every 60 s": (lambda: _propagate(24, 60), 60.0),
        "24 h, 36x36, Sun, Moon, tide, every 60 s": (lambda: _propagate(24, 60, degree=36, tide=True), 0.0),
    }
    durations = interleaved_s({what: run for what, (run, _) in aims_ms.items()})
    for what, (_, aim_ms) in aims_ms.items():
        value = 1e3 * durations[what]
        yield Figure(
            "orbit", what, value, "ms", f"<= {aim_ms:g}" if aim_ms else "", value <= aim_ms if aim_ms else None
        )
    case = np.genfromtxt(CASE, delimiter=",", names=True, skip_header=1)
    want_km = np.stack([case[f"gcrf_{axis}_m"] for axis in "xyz"], axis=1) / 1e3
    away_m = 1e3 * np.linalg.norm(_propagate(24, 600) - want_km, axis=1)
    yield Figure("orbit", "worked case, 3 h", float(away_m[:19].max()), "m", "<= 0.5", bool(away_m[:19].max() <= 0.5))
    yield Figure("orbit", "worked case, 24 h", float(away_m.max()), "m", "<= 2", bool(away_m.max() <= 2.0))

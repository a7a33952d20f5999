"""The energy balance: every figure of the study of the method, with what was published beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import TypeAlias

import numpy as np

from benchmarks.measure import Figure
from magcal_core.energy.balance import EnergyBalance, energy_balance, integrated
from magcal_core.energy.options import EnergyOptions

EPOCH = np.datetime64("2022-02-19T22:37:44.130", "ns")
DEKART = (
    np.array([6861.897826, -934.3811016, -14.66851920]),
    np.array([-0.1222573311, -1.009655310, 7.525523775]),
)
_RADIUS_KM = 6378.1363 + 255.0
_TILT = np.radians(96.7)
GOCE = (
    np.array([_RADIUS_KM, 0.0, 0.0]),
    np.sqrt(398600.4415 / _RADIUS_KM) * np.array([0.0, np.cos(_TILT), np.sin(_TILT)]),
)
FINE = {"noise_position_m": 0.01, "noise_velocity_m_s": 1e-4, "seed": 1}
COARSE = {"noise_position_m": 1.0, "noise_velocity_m_s": 1e-3, "seed": 1}
FORCES = {"third_bodies": True, "tide": True, "drag_density_kg_m3": 1.15e-12, "drag_area_over_mass_m2_kg": 0.002}

Changes: TypeAlias = Mapping[str, object]
State: TypeAlias = tuple[np.ndarray, np.ndarray]

CONSERVATION: tuple[tuple[str, Changes, str, float | None], ...] = (
    ("ideal Earth, std of H", {"third_bodies": False, "rotation": "uniform"}, "std", 8e-6),
    ("real frames, std of H", {"third_bodies": False}, "std", 0.019),
    ("real frames, rotation's change taken along, std", {"third_bodies": False}, "frame", None),
    ("Sun and Moon, exact work, std", {}, "std", 0.019),
    ("Sun and Moon, static potential, std", {"form": "static-tide"}, "std", 2.5),
    ("Sun and Moon, static potential, peak to peak", {"form": "static-tide"}, "p2p", 8.6),
    ("printed (9), peak to peak", {"third_bodies": False, "form": "printed"}, "p2p", 1.26e5),
)
RECOVERY: tuple[tuple[str, State, Changes, float | None], ...] = (
    ("255 km, noise-free", GOCE, {}, 6e-15),
    ("255 km, noise-free, real frames", GOCE, {"rotation": "iers"}, None),
    ("255 km, Sun, Moon, k2, drag, exact", GOCE, FORCES, 7e-15),
    ("255 km, 1 cm, 0.1 mm/s", GOCE, FINE, 1.8e-10),
    ("255 km, 1 cm, 0.1 mm/s, real frames", GOCE, {**FINE, "rotation": "iers"}, 1.8e-10),
    ("255 km, 1 m, 1 mm/s", GOCE, COARSE, 2.9e-9),
    ("560 km, noise-free", DEKART, {}, 8e-15),
    ("560 km, 1 cm, 0.1 mm/s", DEKART, FINE, 2.9e-10),
    ("560 km, 1 m, 1 mm/s", DEKART, COARSE, 5.0e-9),
    ("255 km, 1 day, 1 cm, 0.1 mm/s", GOCE, {**FINE, "duration_s": 86400.0}, 4.2e-10),
    ("printed (9)", GOCE, {"form": "printed"}, 4.9e-5),
    ("rotation with the wrong sign", GOCE, {"form": "rotation-wrong-sign"}, 3.0e-7),
    ("Sun, Moon, drag ignored", GOCE, {**FORCES, "form": "no-correction"}, 1.5e-8),
    ("static tidal potential", GOCE, {**FORCES, "form": "static-tide"}, 2.1e-9),
    ("a.v in place of a.(v - w x r)", GOCE, {**FORCES, "form": "dissipation-inertial"}, 1.1e-10),
    ("collocation, 1 cm, 0.1 mm/s", GOCE, {**FINE, "method": "collocation"}, None),
    ("semi-analytic, noise-free", GOCE, {"method": "semi-analytic"}, None),
    ("semi-analytic, 1 cm, 0.1 mm/s", GOCE, {**FINE, "method": "semi-analytic"}, None),
)


def _balance(state: State, changes: Changes) -> EnergyBalance:
    options = EnergyOptions.from_dict({"duration_s": 86400.0, "step_s": 30.0, **changes})
    return energy_balance(integrated(EPOCH, *state, options), options)


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    for what, changes, kind, published in CONSERVATION:
        balance = _balance(DEKART, changes)
        value = {"std": balance.spread.std, "p2p": balance.spread.peak_to_peak, "frame": balance.frame_free.std}[kind]
        yield Figure("energy", what, value, "m2/s2", *_beside(value, published))
    recovery = {"duration_s": 5 * 86400.0, "recover": 12, "third_bodies": False, "rotation": "uniform"}
    for what, state, changes, published in RECOVERY:
        start = time.perf_counter()
        found = _balance(state, {**recovery, **changes}).recovery
        assert found is not None
        worst = max(found.relative_error_by_degree)
        note = f"residual {found.residual_rms_m2_s2:.3g} m2/s2, worst degree {worst:.2g}, "
        note += f"{time.perf_counter() - start:.1f} s"
        yield Figure("energy", f"recovery: {what}", found.rms_error, "rms", *_beside(found.rms_error, published), note)


def _beside(value: float, published: float | None) -> tuple[str, bool | None]:
    """Return the published figure as an aim, and whether ours is not more than a fifth above it."""
    return ("", None) if published is None else (f"published {published:g}", value <= 1.2 * published)

"""Does the numerical orbit matter? SGP4 and two numerical orbits against a truth that none of them knows, by TLE age.

``python -m benchmarks.orbit_study`` prints the table of docs/numerical-orbit.md.

Truth: EGM96 36x36, Sun, Moon, solid tide and drag. From its positions over two days a TLE is made by least squares, as
those who publish TLEs do; what follows the TLE's epoch is then predicted from the TLE alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from sgp4.api import WGS72, Satrec

from benchmarks.measure import Figure
from magcal_core.field.igrf import Igrf
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.frames import convert_position
from magcal_core.orbit.numerical_fit import fitted_to, numerical_from
from magcal_core.orbit.propagators.forces import ExponentialDrag
from magcal_core.orbit.propagators.numerical import NumericalOrbit
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

STATES = {
    "state 1": ("2022-02-19T22:37:44.130", (6861.897826, -934.3811016, -14.66851920),
                (-0.1222573311, -1.009655310, 7.525523775)),
    "state 2": ("2022-04-07T21:42:49.300", (5387.702395, 4384.530827, -11.64048825),
                (0.6474313881, -0.7969563504, 7.500478986)),
}  # fmt: skip
ARCS_H = ((0, 3), (0, 24), (24, 72), (72, 168), (168, 336))
FIT_DAYS = 2.0
DRAG = ExponentialDrag(4e-13, 0.0088, 6938.137, 67.0)


@dataclass(frozen=True, slots=True)
class FittedElements:
    """Mean elements as a fit finds them: mean motion, eccentricity vector, inclination, node, latitude, B*."""

    epoch_utc: np.datetime64
    values: tuple[float, ...]
    norad_id: str = "00001"
    perigee_km: float = 6500.0
    apogee_km: float = 7500.0

    def satrec(self) -> Satrec:
        motion_rad_min, ex, ey, inclination, node, latitude, bstar = self.values
        perigee = np.arctan2(ey, ex)
        satrec = Satrec()
        since_1949_days = (self.epoch_utc - np.datetime64("1949-12-31")) / np.timedelta64(1, "ns") / 86400e9
        satrec.sgp4init(
            WGS72, "i", 1, since_1949_days, bstar, 0.0, 0.0, np.hypot(ex, ey), perigee % (2 * np.pi), inclination,
            (latitude - perigee) % (2 * np.pi), motion_rad_min, node % (2 * np.pi),
        )  # fmt: skip
        return satrec


def fit_tle(truth: Orbit, epoch_utc: np.datetime64) -> tuple[Sgp4Orbit, float]:
    """Return SGP4 with elements fitted to the ``FIT_DAYS`` before the epoch, and the fit's rms, m."""
    t_utc = epoch_utc - (np.arange(0.0, FIT_DAYS * 86400.0, 180.0) * 1e9).astype("timedelta64[ns]")
    wanted_km = convert_position(t_utc, truth.state_gcrf(t_utc)[0], "GCRF", "TEME")

    def misfit_km(values: Floats) -> Floats:
        orbit = Sgp4Orbit(FittedElements(epoch_utc, tuple(values)))
        return np.asarray((orbit.state_teme(t_utc)[0] - wanted_km).ravel())

    best = least_squares(misfit_km, _start(truth, epoch_utc), x_scale=[1e-7, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
    rms_m = 1e3 * float(np.sqrt(np.mean(np.sum(best.fun.reshape(-1, 3) ** 2, axis=1))))
    return Sgp4Orbit(FittedElements(epoch_utc, tuple(best.x))), rms_m


def _start(truth: Orbit, epoch_utc: np.datetime64) -> Floats:
    """Return mean elements from the mean of a day: node and inclination of the plane, motion from the period."""
    at = np.array([epoch_utc])
    r, v = (convert_position(at, x, "GCRF", "TEME")[0] for x in truth.state_gcrf(at))
    normal = np.cross(r, v)
    normal /= np.linalg.norm(normal)
    node = np.array([-normal[1], normal[0], 0.0])
    node /= np.linalg.norm(node)
    latitude = np.arctan2(r @ np.cross(normal, node), r @ node)
    dense = epoch_utc - (np.arange(0, 86400, 60) * 10**9).astype("timedelta64[ns]")
    r_km, v_km_s = truth.state_gcrf(dense)
    momentum = np.cross(r_km, v_km_s)
    turned = np.unwrap(np.arctan2(np.vecdot(r_km, np.cross(normal, node)), r_km @ node))
    motion_rad_min = -float(np.polyfit(np.arange(len(dense)), turned, 1)[0])
    eccentricity = np.cross(v_km_s, momentum) / 398600.4415 - r_km / np.linalg.norm(r_km, axis=1, keepdims=True)
    ex, ey = eccentricity.mean(axis=0) @ np.stack([node, np.cross(normal, node)], axis=1)
    return np.array([motion_rad_min, ex, ey, np.arccos(normal[2]), np.arctan2(node[1], node[0]), latitude, 1e-5])


def errors(truth: Orbit, orbit: Orbit, epoch_utc: np.datetime64, arc_h: tuple[int, int]) -> tuple[float, float]:
    """Return the largest position error, m, and the largest error of |B|, nT, over an arc after the epoch."""
    t_utc = epoch_utc + (np.arange(arc_h[0] * 3600, arc_h[1] * 3600 + 1, 60) * 10**9).astype("timedelta64[ns]")
    field = Igrf()
    here_km, there_km = truth.position_itrf_km(t_utc), orbit.position_itrf_km(t_utc)
    moved_m = 1e3 * np.linalg.norm(here_km - there_km, axis=1)
    here_nt, there_nt = (np.linalg.norm(field.field_itrf_nt(t_utc, r_km), axis=1) for r_km in (here_km, there_km))
    return float(moved_m.max()), float(np.abs(here_nt - there_nt).max())


Cell = tuple[float, float]


def table(epoch: str, r_km: tuple[float, ...], v_km_s: tuple[float, ...]) -> tuple[float, dict[str, list[Cell]]]:
    """Return the rms of the TLE's fit, m, and for each orbit its largest errors, m and nT, in every arc."""
    start = np.datetime64(epoch, "ns")
    truth = NumericalOrbit(start, r_km, v_km_s, 36, tide=True, drag=DRAG)
    sgp4, rms_m = fit_tle(truth, start)
    orbits: dict[str, Orbit] = {
        "SGP4": sgp4,
        "numerical, one SGP4 state": numerical_from(sgp4, "epoch"),
        "numerical, fit to the day before": fitted_to(sgp4, -86400.0, 0.0),
        "numerical, fit about the epoch": numerical_from(sgp4),
        "numerical, true state, no drag": NumericalOrbit(start, r_km, v_km_s),
    }
    rows = {label: [errors(truth, orbit, start, arc) for arc in ARCS_H] for label, orbit in orbits.items()}
    about = [numerical_from(sgp4, around_utc=start + np.timedelta64(30 * (a + b), "m")) for a, b in ARCS_H]
    rows["numerical, fit about the data"] = [
        errors(truth, orbit, start, arc) for orbit, arc in zip(about, ARCS_H, strict=True)
    ]
    return rms_m, rows


def figures() -> Iterator[Figure]:
    """Yield the figures of this room: the first day after the TLE's epoch."""
    for name, state in STATES.items():
        for label, cells in table(*state)[1].items():
            away_m, away_nt = cells[1]
            yield Figure("orbit study", f"{name}, 0-1 d: {label}", away_m, "m", note=f"{away_nt:.1f} nT in |B|")


def main() -> None:
    for name, state in STATES.items():
        rms_m, rows = table(*state)
        print(f"{name}: TLE fitted to {FIT_DAYS:g} days of truth, rms {rms_m:.0f} m")
        heads = [f"{a / 24:g}-{b / 24:g} d" if b > 3 else f"{a}-{b} h" for a, b in ARCS_H]
        print(f"{'':36}" + "".join(f"{head:>20}" for head in heads))
        for label, cells in rows.items():
            print_row(label, cells)


def print_row(label: str, cells: list[Cell]) -> None:
    print(f"{label:36}" + "".join(f"{m:>11.0f} ({nt:6.1f})" for m, nt in cells))


if __name__ == "__main__":
    main()

"""Steady pointing against the non-orthogonality of the magnetometer: figure 4 of the paper for any scenario."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rom import FieldAlongOrbit, simulate_rom
from magcal_core.attitude.scenario import RomScenario


@dataclass(frozen=True, slots=True, eq=False)
class NonorthogonalitySweep:
    """Largest error of the last two orbits, arcmin, for each angle: equal signs of e1, e2, e3, and the worst signs."""

    angle_arcmin: Floats
    equal_arcmin: Floats
    worst_arcmin: Floats


def sweep_nonorthogonality(scenario: RomScenario, angles_arcmin: Sequence[float]) -> NonorthogonalitySweep:
    """Return the steady error of ``scenario`` with |e1| = |e2| = |e3| at each of ``angles_arcmin``.

    Notes
    -----
    `docs/references.md`: ROM, figure 4. Everything else of the scenario stays as it is.

    Raises
    ------
    ModelRangeError
        The field model does not reach to this orbit or time.
    """
    along = FieldAlongOrbit.of(scenario)
    rows = [
        [_steady_arcmin(scenario, along, angle, signs) for signs in product((1.0, -1.0), repeat=3)]
        for angle in angles_arcmin
    ]
    errors = np.array(rows, np.float64).reshape(-1, 8)
    return NonorthogonalitySweep(np.array(angles_arcmin, np.float64), errors[:, 0], errors.max(axis=1))


def _steady_arcmin(
    scenario: RomScenario, along: FieldAlongOrbit, angle_arcmin: float, signs: tuple[float, ...]
) -> float:
    e1, e2, e3 = (sign * float(np.deg2rad(angle_arcmin / 60.0)) for sign in signs)
    magnetometer = replace(scenario.magnetometer, eps_rad=(e1, e2, e3))
    result = simulate_rom(replace(scenario, magnetometer=magnetometer), along)
    return 60.0 * float(result.error_deg[result.in_last_two_orbits].max())

"""Step 13, gyros: how the magnetometer lies to them, and whether its axes are a left-handed set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.mounting import Mounting
from magcal_core.errors import OptionError
from magcal_core.estimation.estimate import Estimate
from magcal_core.estimation.inertial_field import inertial_field_nt
from magcal_core.observations import corrected_nt
from magcal_core.samples import Samples

if TYPE_CHECKING:
    from magcal_core.calibration.diagnosis.gyro_mounting import GyroMounting

RAD_S: Final = {"deg/s": np.pi / 180.0, "rad/s": 1.0}
_FEWEST: Final = 40


def gyros_of(estimate: Estimate) -> GyroMounting | None:
    """Return how the magnetometer lies to the gyros that the options name; None where they name none.

    Raises
    ------
    OptionError
        There is no such column, or nothing tells the inertial field.
    """
    options, referenced = estimate.options, estimate.prepared.referenced
    if not options.gyro:
        return None
    from magcal_core.calibration.diagnosis.gyro_mounting import GyroMounting, GyroSession, gyro_mounting

    keeping = referenced.samples.housekeeping
    missing = [name for name in options.gyro if name not in keeping]
    if missing:
        raise OptionError(f"gyro: no column {missing[0]!r}; there are {', '.join(keeping) or 'none'}")
    b_nt = inertial_field_nt(referenced, estimate.usable)
    if b_nt is None:
        raise OptionError("gyro: the inertial field is not known; give an orbit, or ref_eci_x, ref_eci_y, ref_eci_z")
    rates = sent_rates(referenced.samples, options.gyro, options.gyro_unit)[estimate.usable]
    known = np.isfinite(rates).all(axis=1) & np.isfinite(b_nt).all(axis=1)
    if np.count_nonzero(known) < _FEWEST:
        return GyroMounting("refused", "few_windows")
    session = GyroSession(
        estimate.observations.t_s[known],
        corrected_nt(estimate.observations, estimate.fit.parameters)[known],
        b_nt[known],
        rates[known],
        estimate.fit.weights[known],
    )
    return gyro_mounting(session)


def sent_rates(samples: Samples, columns: Sequence[str], unit: str) -> Floats:
    """Return the angular rate in the ``columns`` of ``samples``, shape (n, 3), rad/s, along the gyro axes."""
    return np.column_stack([np.asarray(samples.housekeeping[name], np.float64) for name in columns]) * RAD_S[unit]


def mounting_by_gyros(estimate: Estimate, known: Mounting, found: GyroMounting | None) -> Mounting:
    """Return the mounting that is ``known``, or that to the gyro axes where it is free and the gyros resolve it."""
    if known.state != "free" or found is None or found.rotation is None or found.rotation_vector_deg is None:
        return known
    sign = -1.0 if found.handedness == "left" else 1.0
    rotation, parameters = sign * found.rotation, estimate.fit.parameters
    return replace(
        known,
        state="resolved",
        text="the rotation from the gyro axes to the magnetometer's base frame, from the gyros",
        by="gyro",
        rotation=rotation,
        angle_deg=float(np.linalg.norm(found.rotation_vector_deg)),
        rotation_vector_deg=found.rotation_vector_deg,
        standard_errors_deg=found.standard_errors_deg,
        bias_nt=parameters.bias_nt,
        matrix=parameters.matrix @ rotation,
    )

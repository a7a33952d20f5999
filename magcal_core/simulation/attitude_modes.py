"""How the satellites of the population turn: one function a mode, all in `MODES`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import from_rotation_vector, multiply, quaternion_from_matrix, unit
from magcal_core.simulation.flight import Flight
from magcal_core.simulation.magnetic_motion import STEP_S, MagneticBody, integrated
from magcal_core.simulation.ranges import Draws
from magcal_core.simulation.tumbling import Tumbling

Motion: TypeAlias = Callable[[Floats], Floats]
"""Seconds since the start, shape (n,), to attitudes, shape (n, 4): unit quaternions, scalar first, GCRF to body."""
Mode: TypeAlias = Callable[[Draws, Flight, float], Motion]
"""What is drawn, the flight and its duration, s, to a motion."""

_FIELD_STEP_S: Final = 20.0
"""Step of the field that a torque is taken from; between, it is straight to 1e-4."""


def nadir(draws: Draws, flight: Flight, _duration_s: float) -> Motion:
    """Return a motion whose third axis points down and whose second is against the orbit's normal, with a wobble."""
    wobble = _wobble(draws)

    def motion(t_s: Floats) -> Floats:
        r_km, v_km_s = flight.state_gcrf(t_s)
        down, normal = -_unit(r_km), _unit(np.cross(r_km, v_km_s))
        return multiply(_from_axes(np.cross(-normal, down), down), wobble(t_s))

    return motion


def sun(draws: Draws, flight: Flight, _duration_s: float) -> Motion:
    """Return a motion whose third axis points to the Sun; half of them roll about it, all wobble."""
    wobble = _wobble(draws)
    rate_rad_s = np.deg2rad(draws.of("roll_deg_s")) if draws.chance(0.5) else 0.0
    across = draws.direction()

    def motion(t_s: Floats) -> Floats:
        to_sun = _unit(flight.sun_gcrf_km(t_s))
        rolled = from_rotation_vector(rate_rad_s * t_s[:, None] * np.array([0.0, 0.0, 1.0]))
        return multiply(multiply(_from_axes(_unit(np.cross(across, to_sun)), to_sun), rolled), wobble(t_s))

    return motion


def spin(draws: Draws, _flight: Flight, _duration_s: float) -> Motion:
    """Return a spin about an axis that is fixed in the body and in space."""
    return _steady(draws, np.deg2rad(draws.of("spin_deg_s")))


def fast_spin(draws: Draws, _flight: Flight, _duration_s: float) -> Motion:
    """Return a spin that samples every second and more cannot follow: more than half a turn lies between them."""
    return _steady(draws, np.deg2rad(draws.of("fast_spin_deg_s")))


def nutating_spin(draws: Draws, _flight: Flight, _duration_s: float) -> Motion:
    """Return a free spin whose rate is off the axis of the largest or the smallest moment by the nutation drawn."""
    moments = np.sort(draws.random.uniform(0.6, 1.0, 3))
    axis = int(draws.random.choice([0, 2]))
    off, speed = np.deg2rad(draws.of("nutation_deg")), np.deg2rad(draws.of("spin_deg_s"))
    phase = draws.random.uniform(0.0, 2.0 * np.pi)
    rate = np.empty(3)
    rate[[axis, (axis + 1) % 3, (axis + 2) % 3]] = speed * np.array(
        [np.cos(off), np.sin(off) * np.cos(phase), np.sin(off) * np.sin(phase)]
    )
    return _free(moments, rate, _any_attitude(draws))


def tumbling(draws: Draws, _flight: Flight, _duration_s: float) -> Motion:
    """Return a free tumble that starts about any direction."""
    moments = draws.random.uniform(0.6, 1.0, 3)
    return _free(moments, np.deg2rad(draws.vector("tumble_deg_s")), _any_attitude(draws))


def b_dot(draws: Draws, flight: Flight, duration_s: float) -> Motion:
    """Return the motion that coils of the B-dot law leave: the first turn damped, then about two turns an orbit."""
    moments = draws.of("moment_kg_m2") * np.array([1.0, 0.95, 0.7])
    field_t = 1e-9 * _steps_of_field(flight, duration_s)
    damping = moments.mean() / (3600.0 * draws.of("damping_h") * float(np.mean(np.sum(field_t**2, axis=1))))
    body = MagneticBody(moments, damping, np.zeros(3), 0.0, 1.0)
    rate = np.deg2rad(draws.vector("left_deg_s"))
    return integrated(body, 1e9 * field_t, _any_attitude(draws), rate).attitude


def hysteresis_rods(draws: Draws, flight: Flight, duration_s: float) -> Motion:
    """Return the motion of a satellite with a magnet along its third axis, which follows the field, and two rods."""
    moments = draws.of("moment_kg_m2") * np.array([1.0, 0.95, 0.7])
    magnet = np.array([0.0, 0.0, draws.of("magnet_a_m2")])
    body = MagneticBody(moments, 0.0, magnet, draws.of("rod_a_m2"), draws.of("coercive_t"))
    field_nt = _steps_of_field(flight, duration_s)
    along = _unit(field_nt[0])
    aligned = _from_axes(_unit(np.cross(draws.direction(), along))[None], along[None])[0]
    off = from_rotation_vector(np.deg2rad(draws.random.uniform(5.0, 40.0)) * draws.direction())
    return integrated(body, field_nt, multiply(aligned, off), np.deg2rad(draws.vector("left_deg_s"))).attitude


MODES: Final[Mapping[str, Mode]] = {
    "nadir": nadir,
    "sun": sun,
    "spin": spin,
    "nutating spin": nutating_spin,
    "B-dot": b_dot,
    "hysteresis rods": hysteresis_rods,
    "fast spin": fast_spin,
    "tumbling": tumbling,
}


def mounted(draws: Draws, motion: Motion) -> Motion:
    """Return ``motion`` as a magnetometer in any direction in the body has it."""
    mounting = _any_attitude(draws)
    return lambda t_s: multiply(motion(t_s), np.broadcast_to(mounting, (len(t_s), 4)))


def _any_attitude(draws: Draws) -> Floats:
    return unit(draws.random.normal(size=4))


def _unit(v: Floats) -> Floats:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _from_axes(first: Floats, third: Floats) -> Floats:
    """Return the attitudes, shape (n, 4), of which the first and third axis are these, shape (n, 3), GCRF."""
    return quaternion_from_matrix(np.stack([first, np.cross(third, first), third], axis=1))


def _wobble(draws: Draws) -> Motion:
    """Return small turns about all axes, each the sum of two waves of 0.3 to 2 orbits, as large as drawn together."""
    size = np.deg2rad(draws.of("wobble_deg"))
    rates = 2.0 * np.pi / draws.random.uniform(1700.0, 11000.0, (2, 3))
    phases = draws.random.uniform(0.0, 2.0 * np.pi, (2, 3))

    def motion(t_s: Floats) -> Floats:
        waves = np.sin(t_s[:, None, None] * rates + phases).sum(axis=1)
        return from_rotation_vector(size * waves / np.sqrt(12.0))

    return motion


def _steady(draws: Draws, speed_rad_s: float) -> Motion:
    start, rate = _any_attitude(draws), speed_rad_s * draws.direction()
    return lambda t_s: multiply(np.broadcast_to(start, (len(t_s), 4)), unit(from_rotation_vector(t_s[:, None] * rate)))


def _free(moments: Floats, rate_rad_s: Floats, start: Floats) -> Motion:
    body = Tumbling(moments, rate_rad_s, start)
    return lambda t_s: body.motion(t_s)[0]


def _steps_of_field(flight: Flight, duration_s: float) -> Floats:
    """Return the field every step of an integration, shape (m, 3), nT, GCRF."""
    coarse_s = np.arange(0.0, duration_s + 2.0 * _FIELD_STEP_S, _FIELD_STEP_S)
    field_nt, fine_s = flight.field_gcrf_nt(coarse_s), np.arange(0.0, duration_s + 2.0 * STEP_S, STEP_S)
    return np.column_stack([np.interp(fine_s, coarse_s, field_nt[:, i]) for i in range(3)])

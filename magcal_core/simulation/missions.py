"""Simulated missions of all kinds, each with its truth: a number in, a mission out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.field import FieldModel
from magcal_core.field.igrf import Igrf
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.frames import gcrf_to_itrf
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, Simulation, simulate

MOST_SAMPLES: Final = 1200
_EARTH_RADIUS_KM: Final = 6378.135
_GM_KM3_S2: Final = 398600.8


@dataclass(frozen=True, slots=True)
class DisplacedOrbit:
    """What a TLE makes of an orbit: the true one, late along track by ``late_s`` at ``at_utc`` and more every day.

    Its epoch lies ``age_days`` before ``at_utc``, as that of an old TLE would.
    """

    true: Orbit
    at_utc: np.datetime64
    age_days: float
    late_s: float
    drift_s_per_day: float

    @property
    def model(self) -> str:
        """What it passes for."""
        return "sgp4"

    @property
    def epoch_utc(self) -> np.datetime64:
        """Epoch of the elements."""
        return self.at_utc - np.timedelta64(round(self.age_days * 86400e9), "ns")

    def position_itrf_km(self, t_utc: Times) -> Floats:
        """Return the position at ``t_utc``, shape (n, 3), ITRF, km."""
        return gcrf_to_itrf(t_utc, self.state_gcrf(t_utc)[0])

    def state_gcrf(self, t_utc: Times) -> tuple[Floats, Floats]:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), GCRF."""
        days = (t_utc - self.at_utc) / np.timedelta64(1, "ns") / 86400e9
        late_ns = np.round((self.late_s + self.drift_s_per_day * days) * 1e9).astype("timedelta64[ns]")
        return self.true.state_gcrf(t_utc - late_ns)


@dataclass(frozen=True, slots=True, eq=False)
class DisturbedField:
    """The field as it is: the main field, a uniform external one that breathes, and anomalies of the crust.

    Attributes
    ----------
    external_nt, swing_nt : shape (3,)
        Constant and oscillating part, period 6 h, nT, ITRF.
    waves_per_km, phases_rad, crust_nt : shape (w, 3), (w,), (w, 3)
        Anomalies as plane waves.
    """

    main: FieldModel
    external_nt: Floats
    swing_nt: Floats
    waves_per_km: Floats
    phases_rad: Floats
    crust_nt: Floats

    @property
    def name(self) -> str:
        """Name in records."""
        return f"{self.main.name} disturbed"

    @classmethod
    def drawn(cls, random: np.random.Generator) -> DisturbedField:
        """Return a field on a day like many: 10 to 60 nT of external field, 5 nT of crust."""
        axis = np.array([0.0, 0.0, -1.0]) + 0.2 * random.normal(size=3)
        size = random.uniform(10.0, 60.0)
        wavelength_km = random.uniform(800.0, 3000.0, 8)
        directions = random.normal(size=(8, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return cls(
            Igrf(),
            size * axis,
            0.3 * size * axis,
            directions * (2 * np.pi / wavelength_km)[:, None],
            random.uniform(0, 2 * np.pi, 8),
            random.normal(scale=2.5, size=(8, 3)),
        )

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc`` and ``r_itrf_km``, shape (n, 3), ITRF, nT."""
        hours = (t_utc - t_utc[0]) / np.timedelta64(1, "ns") / 3600e9
        external = self.external_nt + np.outer(np.sin(2 * np.pi * hours / 6.0), self.swing_nt)
        crust = np.sin(r_itrf_km @ self.waves_per_km.T + self.phases_rad) @ self.crust_nt
        return np.asarray(self.main.field_itrf_nt(t_utc, r_itrf_km) + external + crust)


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """One simulated mission: what was sent, what it is calibrated with, and the truth."""

    seed: int
    motion: str
    samples: Samples
    orbits: tuple[Orbit, ...]
    options: CalibrationOptions
    truth: SensorModel
    sigma_nt: float
    simulation: Simulation


def draw_mission(seed: int) -> Mission:
    """Return mission number ``seed`` of the population.

    Notes
    -----
    Inclination 0 to 100 deg, height 300 to 1200 km, 2021 to 2024; 6 minutes to 2 days (log-uniform), at most
    `MOST_SAMPLES`; tumbling at 0.05 to 3 deg/s (70 %), turning about one axis (15 %), once per orbit (10 %) or not at
    all (5 %). Noise 20 to 1000 nT (log-uniform). Wave of the bias of 0 to 300 nT with a period of 20 to 200 minutes,
    temperature up to 15 nT/K, drift up to 40 nT/h, spikes of 2 to 20 uT in up to 5 %, dropouts. TLE 0 to 10 days old.
    Sensor mild (10 %, 3 deg, 5 uT) or, in a third, strong (0.4 to 2.5, 30 deg, 50 uT). Two thirds scalar, one third
    vector with up to 1 deg of attitude noise; one half with Huber's loss.
    """
    random = np.random.default_rng(seed)
    start = np.datetime64("2021-01-01T00:00:00", "ns") + np.timedelta64(int(random.uniform(0, 4 * 365.25 * 86400)), "s")
    true_orbit = draw_orbit(random, start)
    duration_s = float(np.exp(random.uniform(np.log(360.0), np.log(2 * 86400.0))))
    step_s = max(float(random.choice([1.0, 2.0, 5.0, 10.0, 30.0])), float(np.ceil(duration_s / MOST_SAMPLES)))
    motion = str(random.choice(["tumbling", "one axis", "once per orbit", "still"], p=[0.7, 0.15, 0.1, 0.05]))
    truth, is_vector = _sensor(random), bool(random.random() < 1 / 3)
    disturbed = _disturbances(random, is_vector=is_vector)
    field = DisturbedField.drawn(random)
    made = simulate(
        true_orbit,
        truth,
        start,
        duration_s,
        step_s,
        field_model=field,
        rate_deg_s=_rate_deg_s(random, motion),
        moments=(0.08, 0.1, 0.06),
        disturbances=disturbed,
        seed=seed,
    )
    age_days = float(random.uniform(0.0, 10.0))
    late_s = float(random.normal()) * (0.64 + 1.5 * age_days + 0.2 * age_days**2) / 7.6
    reference = DisplacedOrbit(true_orbit, start, age_days, late_s, float(random.normal()) * (0.2 + 0.05 * age_days))
    robust = str(random.choice(["none", "huber"]))
    options = CalibrationOptions(method="vector" if is_vector else "scalar", robust=robust)
    return Mission(seed, motion, made.samples, (reference,), options, truth, disturbed.noise_nt, made)


def draw_orbit(random: np.random.Generator, start: np.datetime64) -> Sgp4Orbit:
    """Return a low orbit with its epoch at ``start``: 300 to 1200 km, inclination 0 to 100 deg."""
    return Sgp4Orbit.from_tle(_tle_text(random, start))


def _tle_text(random: np.random.Generator, start: np.datetime64) -> str:
    height_km, inclination = (
        random.uniform(300.0, 1200.0),
        np.rad2deg(np.arccos(random.uniform(np.cos(np.deg2rad(100)), 1))),
    )
    raan, argument, anomaly = random.uniform(0.0, 360.0, 3)
    eccentricity = random.uniform(0.0001, 0.004)
    revolutions = 86400.0 / (2 * np.pi) * np.sqrt(_GM_KM3_S2 / (_EARTH_RADIUS_KM + height_km) ** 3)
    year = int(str(start)[:4])
    day = 1.0 + (start - np.datetime64(f"{year}-01-01T00:00:00", "ns")) / np.timedelta64(1, "ns") / 86400e9
    first = f"1 99999U 21001A   {year % 100:02d}{day:012.8f}  .00000000  00000-0  00000+0 0    0"
    second = (
        f"2 99999 {inclination:8.4f} {raan:8.4f} {round(eccentricity * 1e7):07d} {argument:8.4f} {anomaly:8.4f} "
        f"{revolutions:11.8f}    0"
    )
    return "\n".join(line + str(_checksum(line)) for line in (first, second))


def _checksum(line: str) -> int:
    return sum(int(c) if c.isdigit() else c == "-" for c in line) % 10


def _sensor(random: np.random.Generator) -> SensorModel:
    if random.random() < 1 / 3:
        scale = np.exp(random.uniform(np.log(0.4), np.log(2.5), 3))
        return SensorModel(random.uniform(-50000, 50000, 3), scale, random.uniform(-30.0, 30.0, 3))
    return SensorModel(random.uniform(-5000, 5000, 3), random.uniform(0.9, 1.1, 3), random.uniform(-3.0, 3.0, 3))


def _rate_deg_s(random: np.random.Generator, motion: str) -> Sequence[float]:
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction)
    speed = float(np.exp(random.uniform(np.log(0.05), np.log(3.0))))
    rates = {
        "tumbling": speed * direction,
        "one axis": speed * np.eye(3)[random.integers(3)],
        "once per orbit": 0.0635 * np.eye(3)[random.integers(3)],
        "still": np.zeros(3),
    }
    return [float(x) for x in rates[motion]]


def _disturbances(random: np.random.Generator, *, is_vector: bool) -> Disturbances:
    def vector(size: float) -> tuple[float, float, float]:
        x, y, z = (random.uniform(0, size) * random.normal(size=3) / np.sqrt(3.0)).tolist()
        return x, y, z

    has_spikes = random.random() < 0.4
    return Disturbances(
        noise_nt=float(np.exp(random.uniform(np.log(20.0), np.log(1000.0)))),
        outlier_fraction=float(random.uniform(0.0, 0.05)) if has_spikes else 0.0,
        outlier_nt=float(random.uniform(2000.0, 20000.0)),
        dropout_fraction=float(random.uniform(0.0, 0.2)),
        temperature_nt_per_k=vector(15.0),
        wave_nt=vector(300.0),
        wave_period_s=float(random.uniform(1200.0, 12000.0)),
        drift_nt_per_h=vector(40.0),
        attitude_noise_deg=float(random.uniform(0.0, 1.0)) if is_vector else 0.0,
    )

"""Simulated missions of all kinds, each with its truth: a number in, a mission out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.signal import lfilter

from magcal_core.arrays import Floats, Mask, Times
from magcal_core.field import FieldModel
from magcal_core.field.external import ExternalField
from magcal_core.field.hourly import hourly
from magcal_core.field.igrf import MAX_RADIUS_KM, Igrf
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.summed import SummedField
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth.frames import gcrf_to_itrf
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.telemetry import Disturbances, simulate

MOST_SAMPLES: Final = 1200
FREE_MOTION: Final = "free motion"
"""Kind of the missions of `draw_mission`."""
_EARTH_RADIUS_KM: Final = 6378.135
_GM_KM3_S2: Final = 398600.8
_HOURS: Final = 14 * 24
"""Hours of an index about a mission."""
_MEAN_NT, _SCATTER_NT, _MEMORY_H, _INDUCED = -13.0, 22.0, 12.0, 0.2


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
    """The field as it is: the main field, an external one that an hourly index drives, and anomalies of the crust.

    Attributes
    ----------
    main : SummedField
        The main field with the external one.
    other_nt : shape (3,)
        A uniform field that no index tells of, nT, ITRF.
    waves_per_km, phases_rad, crust_nt : shape (w, 3), (w,), (w, 3)
        Anomalies as plane waves.
    """

    main: FieldModel
    other_nt: Floats
    waves_per_km: Floats
    phases_rad: Floats
    crust_nt: Floats

    @property
    def name(self) -> str:
        """Name in records."""
        return f"{self.main.name} disturbed"

    @classmethod
    def drawn(cls, random: np.random.Generator, start_utc: np.datetime64, index: Index | None = None) -> DisturbedField:
        """Return a field on days like many: the external field of some days of the ``index``, 5 nT of crust.

        The days are drawn from the whole index and moved to ``start_utc``. Without an index its hours are drawn: a mean
        of -13 nT with a scatter of 22 nT that half a day forgets, a fifth of it induced, as RC of 2015 to 2026.
        """
        driver = _drawn_index(random, start_utc) if index is None else _moved_index(random, start_utc, index)
        series = hourly([driver], "RC")
        external = None if series is None else ExternalField.by_index("rc", series, "mean")
        wavelength_km = random.uniform(800.0, 3000.0, 8)
        directions = random.normal(size=(8, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return cls(
            SummedField(Igrf(), None, external),
            random.normal(0.0, 2.0, 3),
            directions * (2 * np.pi / wavelength_km)[:, None],
            random.uniform(0, 2 * np.pi, 8),
            random.normal(scale=2.5, size=(8, 3)),
        )

    @classmethod
    def drawn_far(cls, random: np.random.Generator) -> DisturbedField:
        """Return a field for orbits that no index of the external field covers: 15 nT a component, no crust."""
        nothing = np.zeros((1, 3))
        return cls(FarField(Igrf()), random.normal(0.0, 15.0, 3), nothing, np.zeros(1), nothing)

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc`` and ``r_itrf_km``, shape (n, 3), ITRF, nT."""
        crust = np.sin(r_itrf_km @ self.waves_per_km.T + self.phases_rad) @ self.crust_nt
        return np.asarray(self.main.field_itrf_nt(t_utc, r_itrf_km) + self.other_nt + crust)


@dataclass(frozen=True, slots=True)
class FarField:
    """The main field at any height: beyond the reach of ``main`` that at its reach, weakened as a dipole's."""

    main: FieldModel

    @property
    def name(self) -> str:
        """Name in records."""
        return f"{self.main.name} far"

    def field_itrf_nt(self, t_utc: Times, r_itrf_km: Floats) -> Floats:
        """Return the field at ``t_utc`` and ``r_itrf_km``, shape (n, 3), ITRF, nT."""
        beyond = np.maximum(np.linalg.norm(r_itrf_km, axis=1, keepdims=True) / (MAX_RADIUS_KM - 1.0), 1.0)
        return np.asarray(self.main.field_itrf_nt(t_utc, r_itrf_km / beyond) / beyond**3)


def _drawn_index(random: np.random.Generator, start_utc: np.datetime64) -> Index:
    """Return some days of an index, RC with its parts, that begin a day before ``start_utc``."""
    share = np.exp(-1.0 / _MEMORY_H)
    steps = random.normal(0.0, _SCATTER_NT, _HOURS)
    steps[1:] *= np.sqrt(1.0 - share**2)
    total = _MEAN_NT + lfilter([1.0], [1.0, -share], steps)
    first_ns = (int(start_utc.astype("datetime64[ns]").astype(np.int64)) // HOUR_NS - 24) * HOUR_NS
    start_ns = first_ns + HOUR_NS * np.arange(_HOURS)
    return Index("RC", "csv", start_ns, HOUR_NS, total, (1.0 - _INDUCED) * total, _INDUCED * total, "")


def _moved_index(random: np.random.Generator, start_utc: np.datetime64, index: Index) -> Index:
    """Return some days of ``index`` from a random place in it, moved so that they begin a day before ``start_utc``."""
    first = int(random.integers(0, index.rows - _HOURS))
    taken = index.between(int(index.start_ns[first]) + 1, int(index.start_ns[first + _HOURS - 1]))
    begin_ns = (int(start_utc.astype("datetime64[ns]").astype(np.int64)) // HOUR_NS - 24) * HOUR_NS
    return replace(taken, start_ns=taken.start_ns - int(taken.start_ns[0]) + begin_ns)


@dataclass(frozen=True, slots=True, eq=False)
class Mission:
    """One simulated mission: what was sent, what it is calibrated with, and the truth.

    Attributes
    ----------
    kind, motion : what was drawn, in words.
    truth : the sensor without what moves its bias; ``cubic_share`` is how far its response bends (`electronics.cubic`).
    sigma_nt : standard deviation of the white noise of a reading, nT.
    b_base_nt, moved_nt : shape (n, 3)
        True field in the base frame, and by how much the bias is off that of ``truth``, nT.
    is_sound : shape (n,)
        Readings that tell of the field: no spike, not cut, not stuck, within the field model's reach.
    light : shape (n,), optional
        Share of the Sun that is seen, where it was followed.
    is_determined : whether the readings can determine a calibration at all; where not, a refusal is right.
    drawn : range -> the figure that was drawn from it.
    """

    seed: int
    kind: str
    motion: str
    samples: Samples
    orbits: tuple[Orbit, ...]
    options: CalibrationOptions
    truth: SensorModel
    sigma_nt: float
    b_base_nt: Floats
    moved_nt: Floats
    is_sound: Mask
    light: Floats | None = None
    cubic_share: Floats = field(default_factory=lambda: np.zeros(3))
    is_determined: bool = True
    drawn: Mapping[str, float] = field(default_factory=dict)


def draw_mission(seed: int, index: Index | None = None) -> Mission:
    """Return mission number ``seed`` of the population; its external field is that of some days of the ``index``.

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
    truth, is_vector = draw_sensor(random), bool(random.random() < 1 / 3)
    disturbed = _disturbances(random, is_vector=is_vector)
    field = DisturbedField.drawn(random, start, index)
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
    reference = displaced(random, true_orbit, start, float(random.uniform(0.0, 10.0)))
    robust = str(random.choice(["none", "huber"]))
    options = CalibrationOptions(method="vector" if is_vector else "scalar", robust=robust)
    outliers = made.truth["outlier_rows"]
    return Mission(
        seed,
        FREE_MOTION,
        motion,
        made.samples,
        (reference,),
        options,
        truth,
        disturbed.noise_nt,
        made.b_base_nt,
        made.samples.h_nt - truth.apply(made.b_base_nt),
        ~np.isin(np.arange(len(made.samples)), outliers if isinstance(outliers, list) else []),
    )


def displaced(random: np.random.Generator, true: Orbit, start: np.datetime64, age_days: float) -> DisplacedOrbit:
    """Return what a TLE of that age makes of an orbit, with the error along the track that such TLEs have."""
    late_s = float(random.normal()) * (0.64 + 1.5 * age_days + 0.2 * age_days**2) / 7.6
    return DisplacedOrbit(true, start, age_days, late_s, float(random.normal()) * (0.2 + 0.05 * age_days))


def draw_orbit(random: np.random.Generator, start: np.datetime64) -> Sgp4Orbit:
    """Return a low orbit with its epoch at ``start``: 300 to 1200 km, inclination 0 to 100 deg."""
    return Sgp4Orbit.from_tle(_tle_text(random, start))


def draw_transfer_orbit(random: np.random.Generator, start: np.datetime64, draws: Mapping[str, float]) -> Sgp4Orbit:
    """Return a geostationary transfer orbit with its epoch at ``start``: heights, km, and inclination as ``draws``."""
    perigee_km, apogee_km = (_EARTH_RADIUS_KM + draws[f"transfer_{end}_km"] for end in ("perigee", "apogee"))
    radius_km = 0.5 * (perigee_km + apogee_km)
    shape = (apogee_km - perigee_km) / (apogee_km + perigee_km)
    text = _tle(random, start, radius_km, draws["transfer_inclination_deg"], lambda: shape)
    return Sgp4Orbit.from_tle(text)


def _tle_text(random: np.random.Generator, start: np.datetime64) -> str:
    height_km, inclination = (
        random.uniform(300.0, 1200.0),
        np.rad2deg(np.arccos(random.uniform(np.cos(np.deg2rad(100)), 1))),
    )
    return _tle(random, start, _EARTH_RADIUS_KM + height_km, inclination, lambda: random.uniform(0.0001, 0.004))


def _tle(
    random: np.random.Generator,
    start: np.datetime64,
    radius_km: float,
    inclination: float,
    shape: Callable[[], float],
) -> str:
    """Return a TLE of that mean radius, its angles drawn, then its eccentricity from ``shape``."""
    raan, argument, anomaly = random.uniform(0.0, 360.0, 3)
    eccentricity = shape()
    revolutions = 86400.0 / (2 * np.pi) * np.sqrt(_GM_KM3_S2 / radius_km**3)
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


def draw_sensor(random: np.random.Generator) -> SensorModel:
    """Return a sensor, mild (10 %, 3 deg, 5 uT) or, in a third, strong (0.4 to 2.5, 30 deg, 50 uT)."""
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

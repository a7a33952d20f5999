"""Sessions under an external field that an index of a file drives: whether 95 % intervals hold the scale factors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import rotate, unit
from magcal_core.constants import EARTH_GM_KM3_S2, EARTH_RADIUS_MAGNETIC_KM, EARTH_ROTATION_RAD_S
from magcal_core.field.external import ExternalField
from magcal_core.field.hourly import hourly
from magcal_core.field.igrf import Igrf
from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.summed import SummedField
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.simulation.tumbling import Tumbling

SAMPLES: Final = 480
STEP_S: Final = 24.0
"""Samples of a session and the time between them: 3.2 h."""
NOISE_NT: Final = 3.0
BASELINE_NT: Final = 6.7
"""Scatter of the monthly means of Dst - RC, nT."""
OTHER_NT: Final = 2.0
"""Size of a component of a uniform field, nT, that no index tells of: what `+rc` leaves, with the asymmetry."""
ASYMMETRY: Final = 0.05
"""Scatter of the ring current's strength at the satellite, as a share of the index."""
_WARM_UP_NS: Final = 5000 * HOUR_NS


@dataclass(frozen=True, slots=True, eq=False)
class ExternalSession:
    """One session with positions, the sensor that made it, and the indices that a calibration may be given."""

    samples: Samples
    sensor: SensorModel
    rc: Index
    dst: Index


def external_session(index: Index, inclination_deg: float, seed: int) -> ExternalSession:
    """Return session number ``seed`` on a circular orbit of that inclination, its instant drawn from the ``index``.

    Notes
    -----
    300 to 1500 km, a sensor of 5 %, 3 deg and 5 uT, noise of 3 nT. The field is IGRF-14 with B_ext of RC, whose
    strength at the satellite scatters by 5 %, and a uniform field of 2 nT a component.
    """
    random = np.random.default_rng([seed, int(10 * inclination_deg)])
    first, last = int(index.start_ns[0]) + _WARM_UP_NS, int(index.start_ns[-1])
    begin_ns = first + int(random.uniform() * (last - first - 4 * HOUR_NS))
    rc = index.between(begin_ns - _WARM_UP_NS, begin_ns + 5 * HOUR_NS)
    t_s = STEP_S * np.arange(SAMPLES, dtype=np.float64)
    t_utc = np.datetime64(begin_ns, "ns") + (t_s * 1e9).astype("timedelta64[ns]")
    r_km = circular_orbit_km(random, inclination_deg, t_s)
    b_nt = _field_nt(random, rc, t_utc, r_km)
    sensor = drawn_sensor(random)
    body = Tumbling(np.array([0.08, 0.1, 0.06]), random.normal(0.0, 0.012, 3), unit(random.normal(size=4)))
    h_nt = sensor.apply(rotate(body.motion(t_s)[0], b_nt)) + random.normal(0.0, NOISE_NT, (SAMPLES, 3))
    none = np.full(rc.rows, np.nan)
    moved = rc.value + random.normal(0.0, BASELINE_NT)
    dst = replace(rc, name="Dst", value=moved, external_nt=none, induced_nt=none)
    return ExternalSession(Samples(t_utc, h_nt, r_itrf_km=r_km), sensor, rc, dst)


def scale_held(field: str, index: Index, inclination_deg: float, seed: int) -> NDArray[np.bool_]:
    """Return whether the 95 % interval of each scale factor holds the truth in one session, shape (3,)."""
    made = external_session(index, inclination_deg, seed)
    given = {"igrf-14+rc": made.rc, "igrf-14+dst": made.dst}.get(field)
    found = calibrate(made.samples, field=field, index=given)
    away = np.abs(found.parameters.scale - made.sensor.scale)
    return np.asarray(away <= 1.96 * found.standard_errors.scale)


def _field_nt(random: np.random.Generator, rc: Index, t_utc: Times, r_km: Floats) -> Floats:
    share = 1.0 + ASYMMETRY * random.normal()
    stronger = replace(rc, external_nt=share * rc.external_nt, induced_nt=share * rc.induced_nt)
    series = hourly([stronger], "RC")
    external = None if series is None else ExternalField.by_index("rc", series, "mean")
    model = SummedField(Igrf(), None, external)
    return model.field_itrf_nt(t_utc, r_km) + random.normal(0.0, OTHER_NT, 3)


def drawn_sensor(random: np.random.Generator) -> SensorModel:
    """Return a sensor of 5 %, 3 deg and 5 uT."""
    return SensorModel(random.uniform(-5000, 5000, 3), random.uniform(0.95, 1.05, 3), random.uniform(-3.0, 3.0, 3))


def circular_orbit_km(random: np.random.Generator, inclination_deg: float, t_s: Floats) -> Floats:
    """Return positions on a circular orbit 300 to 1500 km high at ``t_s``, shape (n,), s: shape (n, 3), ITRF, km."""
    radius_km = EARTH_RADIUS_MAGNETIC_KM + random.uniform(300.0, 1500.0)
    along = random.uniform(0.0, 2 * np.pi) + np.sqrt(EARTH_GM_KM3_S2 / radius_km**3) * t_s
    node = random.uniform(0.0, 2 * np.pi) - EARTH_ROTATION_RAD_S * t_s
    tilt = np.deg2rad(inclination_deg)
    x, y, z = np.cos(along), np.sin(along) * np.cos(tilt), np.sin(along) * np.sin(tilt)
    return radius_km * np.stack([x * np.cos(node) - y * np.sin(node), x * np.sin(node) + y * np.cos(node), z], axis=1)

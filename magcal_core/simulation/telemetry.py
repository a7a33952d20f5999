"""Telemetry of a tumbling satellite, with its truth: the same sensor model that the estimators fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.attitude.rotation import from_rotation_vector, multiply, rotate, unit
from magcal_core.calibration.result import utc_text
from magcal_core.errors import OptionError
from magcal_core.field import FieldModel
from magcal_core.orbit import Orbit
from magcal_core.orbit.earth import frames
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.tumbling import Tumbling

MAX_SAMPLES: Final = 20_000_000
"""Most samples of one simulation."""
DEKART_MOMENTS: Final = (0.0973, 0.0785, 0.0313)
"""Principal moments of a homogeneous box of 7.5 kg, 100 x 200 x 340 mm, kg m2: the size of DEKART [DEKART]_."""
DEKART_RATE_DEG_S: Final = 0.76
"""Tumbling rate, deg/s, of the DEKART studies."""
MEAN_TEMPERATURE_C: Final = 20.0
TEMPERATURE_SWING_K: Final = 15.0
"""Amplitude of the simulated sensor temperature around its mean, K."""

_STREAMS: Final = ("attitude", "noise", "outliers", "dropouts", "attitude noise", "wave")


@dataclass(frozen=True, slots=True)
class Disturbances:
    """What stands between the field and the telemetry, beside the sensor itself.

    Attributes
    ----------
    noise_nt : 1 sigma of each reading, nT.
    outlier_fraction, outlier_nt : share of readings with a spike, and its length, nT, in a random direction.
    dropout_fraction : share of samples that never arrive.
    range_nt : readings are cut at +- this, nT; None for a sensor without limits.
    time_offset_s : seconds to add to the telemetry's clock to have true time.
    temperature_nt_per_k : shape (3,), change of the bias with temperature, nT/K; where it is not zero the telemetry
        has a column ``temperature``, deg C.
    temperature_period_s : period of the temperature, s.
    wave_nt, wave_period_s : shape (3,), amplitude, nT, and period, s, of a wave of the bias that no column explains.
    drift_nt_per_h : shape (3,), drift of the bias, nT/h.
    attitude_noise_deg : 1 sigma of the error of the attitude sent, deg, about each axis.
    """

    noise_nt: float = 0.0
    outlier_fraction: float = 0.0
    outlier_nt: float = 5000.0
    dropout_fraction: float = 0.0
    range_nt: float | None = None
    time_offset_s: float = 0.0
    temperature_nt_per_k: tuple[float, float, float] = (0.0, 0.0, 0.0)
    temperature_period_s: float = 5700.0
    wave_nt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wave_period_s: float = 2400.0
    drift_nt_per_h: tuple[float, float, float] = (0.0, 0.0, 0.0)
    attitude_noise_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in ("outlier_fraction", "dropout_fraction"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise OptionError(f"{name} is {getattr(self, name)}; want 0 or more and less than 1")
        for name in ("noise_nt", "outlier_nt", "attitude_noise_deg"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise OptionError(f"{name} is {getattr(self, name)}; want 0 or more")
        for name in ("temperature_period_s", "wave_period_s", "range_nt"):
            if getattr(self, name) is not None and not getattr(self, name) > 0.0:
                raise OptionError(f"{name} is {getattr(self, name)}; want more than 0")

    @property
    def has_temperature(self) -> bool:
        """Whether the bias changes with temperature."""
        return any(self.temperature_nt_per_k)


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """Telemetry as a satellite sends it, and what it does not send.

    Attributes
    ----------
    samples : readings, attitude and, where asked for, temperature; no reference columns.
    truth : everything that made them, as JSON has it.
    t_true_utc : datetime64[ns], shape (n,)
        True time of each sample, UTC.
    b_base_nt : shape (n, 3)
        True field in the magnetometer's base frame, nT.
    r_itrf_km : shape (n, 3)
        True position, ITRF, km.
    """

    samples: Samples
    truth: Mapping[str, object]
    t_true_utc: Times
    b_base_nt: Floats
    r_itrf_km: Floats

    @property
    def samples_with_reference(self) -> Samples:
        """The samples with the true field beside them, in the base frame and as a magnitude."""
        magnitude = np.sqrt(np.einsum("ij,ij->i", self.b_base_nt, self.b_base_nt))
        return replace(self.samples, b_ref_base_nt=self.b_base_nt, b_ref_magnitude_nt=magnitude)


@dataclass(frozen=True, slots=True)
class _Streams:
    """One random stream a purpose: switching one disturbance on leaves the others as they were."""

    by_purpose: Mapping[str, np.random.Generator] = field(default_factory=dict)

    @classmethod
    def of(cls, seed: int) -> _Streams:
        children = np.random.SeedSequence(seed).spawn(len(_STREAMS))
        return cls({name: np.random.default_rng(child) for name, child in zip(_STREAMS, children, strict=True)})

    def __getitem__(self, purpose: str) -> np.random.Generator:
        return self.by_purpose[purpose]


def simulate(
    orbit: Orbit,
    sensor: SensorModel,
    start_utc: np.datetime64,
    duration_s: float,
    step_s: float,
    *,
    field_model: FieldModel | None = None,
    rate_deg_s: float | Sequence[float] = DEKART_RATE_DEG_S,
    moments: Sequence[float] = DEKART_MOMENTS,
    disturbances: Disturbances | None = None,
    seed: int = 0,
) -> Simulation:
    """Return the telemetry of a satellite that tumbles freely along ``orbit``; the same seed gives the same bytes.

    Parameters
    ----------
    start_utc, duration_s, step_s
        True time of the first sample, UTC; samples follow every ``step_s`` seconds for ``duration_s`` seconds.
    field_model : FieldModel, optional
        IGRF-14 unless given.
    rate_deg_s : float or shape (3,)
        Angular rate at the start, deg/s: its size, in a random direction, or its body components.
    moments : shape (3,)
        Principal moments of inertia, in any unit; the magnetometer's base frame lies along their axes.
    disturbances : Disturbances, optional
        None: the sensor alone.

    Raises
    ------
    OptionError
        An option has a value that it cannot have.
    InputError, PropagationError
        Orbit or field cannot be computed at a time.

    Notes
    -----
    h = T B + b + n with B = C(q) B_gcrf [DEKART]_.
    """
    disturbed = disturbances or Disturbances()
    streams = _Streams.of(seed)
    t_s = _instants(duration_s, step_s)
    t_utc = start_utc.astype("datetime64[ns]") + np.rint(t_s * 1e9).astype("timedelta64[ns]")
    model = field_model or _igrf()
    r_itrf_km = orbit.position_itrf_km(t_utc)
    b_itrf_nt = model.field_itrf_nt(t_utc, r_itrf_km)
    b_gcrf_nt = frames.rotate(np.swapaxes(frames.gcrf_to_itrf_matrix(t_utc), 1, 2), b_itrf_nt)
    body = _body(rate_deg_s, moments, streams["attitude"])
    q, _ = body.motion(t_s)
    b_base_nt = rotate(q, b_gcrf_nt)
    h_nt, housekeeping, outliers = _readings(sensor.apply(b_base_nt), t_s, disturbed, streams)
    arrived = streams["dropouts"].random(len(t_s)) >= disturbed.dropout_fraction
    offset_ns = np.timedelta64(round(disturbed.time_offset_s * 1e9), "ns")
    samples = Samples(t_utc - offset_ns, h_nt, _sent(q, disturbed, streams), housekeeping=housekeeping).take(arrived)
    truth = {
        "parameters": _parameters(sensor, disturbed).to_dict(),
        "matrix": sensor.matrix.tolist(),
        "seed": seed,
        "start": utc_text(t_utc[0]),
        "duration_s": duration_s,
        "step_s": step_s,
        "samples": len(samples),
        "dropped": int(np.count_nonzero(~arrived)),
        "outlier_rows": np.flatnonzero(outliers[arrived]).tolist(),
        "saturated_rows": _saturated(samples, disturbed.range_nt),
        "orbit": {"model": orbit.model, "epoch": utc_text(orbit.epoch_utc)},
        "field_model": model.name,
        "attitude": {
            "moments": body.moments.tolist(),
            "rate_deg_s": np.rad2deg(body.rate_rad_s).tolist(),
            "q_base_gcrf": body.q0.tolist(),
        },
        "disturbances": {name: getattr(disturbed, name) for name in disturbed.__slots__},
    }
    return Simulation(samples, truth, t_utc[arrived], b_base_nt[arrived], r_itrf_km[arrived])


def _igrf() -> FieldModel:
    from magcal_core.field.igrf import Igrf

    return Igrf()


def _instants(duration_s: float, step_s: float) -> Floats:
    if not (0.0 < step_s < np.inf and 0.0 < duration_s < np.inf):
        raise OptionError(f"duration {duration_s} s, step {step_s} s; want both more than 0")
    # A duration of n steps has n samples, whatever the rounding of their quotient.
    count = int(np.ceil(round(duration_s / step_s, 9)))
    if count > MAX_SAMPLES:
        raise OptionError(f"{count} samples; the limit is {MAX_SAMPLES}")
    return step_s * np.arange(count, dtype=np.float64)


def _body(rate_deg_s: float | Sequence[float], moments: Sequence[float], random: np.random.Generator) -> Tumbling:
    q0, direction = unit(random.normal(size=4)), unit(random.normal(size=3))
    given = np.deg2rad(np.asarray(rate_deg_s, np.float64))
    rate = given * direction if given.ndim == 0 else given
    return Tumbling(np.asarray(moments, np.float64), rate, q0)


def _readings(
    ideal_nt: Floats, t_s: Floats, disturbed: Disturbances, streams: _Streams
) -> tuple[Floats, dict[str, Floats], NDArray[np.bool_]]:
    """Return readings, nT, shape (n, 3), the housekeeping beside them, and which readings have a spike."""
    n = len(t_s)
    h_nt = ideal_nt + np.outer(t_s / 3600.0, disturbed.drift_nt_per_h)
    phases = streams["wave"].uniform(0.0, 2.0 * np.pi, 2)
    h_nt += np.outer(np.sin(2.0 * np.pi * t_s / disturbed.wave_period_s + phases[0]), disturbed.wave_nt)
    housekeeping: dict[str, Floats] = {}
    if disturbed.has_temperature:
        swing = np.sin(2.0 * np.pi * t_s / disturbed.temperature_period_s + phases[1])
        housekeeping["temperature"] = MEAN_TEMPERATURE_C + TEMPERATURE_SWING_K * swing
        h_nt += np.outer(housekeeping["temperature"], disturbed.temperature_nt_per_k)
    h_nt += disturbed.noise_nt * streams["noise"].normal(size=(n, 3))
    is_outlier = streams["outliers"].random(n) < disturbed.outlier_fraction
    spikes = disturbed.outlier_nt * unit(streams["outliers"].normal(size=(n, 3)))
    h_nt[is_outlier] += spikes[is_outlier]
    if disturbed.range_nt is not None:
        h_nt = np.clip(h_nt, -disturbed.range_nt, disturbed.range_nt)
    return h_nt, housekeeping, is_outlier


def _sent(q: Floats, disturbed: Disturbances, streams: _Streams) -> Floats:
    """Return the attitude as the satellite knows it, shape (n, 4)."""
    if not disturbed.attitude_noise_deg:
        return q
    errors = np.deg2rad(disturbed.attitude_noise_deg) * streams["attitude noise"].normal(size=(len(q), 3))
    return unit(multiply(q, from_rotation_vector(errors)))


def _parameters(sensor: SensorModel, disturbed: Disturbances) -> Parameters:
    regressors = {"temperature": np.array(disturbed.temperature_nt_per_k)} if disturbed.has_temperature else {}
    return Parameters(sensor.bias_nt, sensor.scale, sensor.nonorthogonality_deg, disturbed.time_offset_s, regressors)


def _saturated(samples: Samples, range_nt: float | None) -> list[int]:
    if range_nt is None:
        return []
    return np.flatnonzero((np.abs(samples.h_nt) >= range_nt).any(axis=1)).tolist()

"""Worked cases and small simulated missions that need neither orbit nor field model."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.telemetry import read_samples
from magcal_core.telemetry.screen import unscreened

TABLE_1 = SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])


@dataclass(frozen=True)
class Case:
    """A worked case: samples and the answer that an independent implementation gave."""

    samples: Samples
    answer: dict

    @property
    def expected(self) -> dict:
        return self.answer["expected"]


@pytest.fixture(scope="session")
def case(data_dir: Path) -> Callable[[str], Case]:
    folder = data_dir / "calibration"

    def load(name: str) -> Case:
        return Case(
            unscreened(read_samples(folder / f"{name}.csv")), json.loads((folder / f"{name}.answer.json").read_text())
        )

    return load


def directions(motion: str, n: int, rng: np.random.Generator, rate_deg_s: float = 0.76) -> NDArray[np.float64]:
    """Unit vectors of the field in the base frame, sampled every 10 s."""
    turn = np.deg2rad(rate_deg_s) * 10.0 * np.arange(n)
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if motion == "tumble":
        slow = 0.41 * turn
        u = np.c_[
            np.cos(turn) * np.cos(slow),
            0.8 * np.sin(turn) * np.cos(slow) + 0.6 * np.sin(slow),
            0.8 * np.sin(slow) - 0.6 * np.sin(turn) * np.cos(slow),
        ]
    elif motion == "planar":
        u = np.c_[np.cos(turn), np.sin(turn), 0 * turn]
    elif motion == "cone":
        u = np.c_[0.8 * np.cos(turn), 0.8 * np.sin(turn), 0.6 + 0 * turn]
    elif motion == "six faces":
        u = np.vstack([np.eye(3), -np.eye(3)])[rng.integers(0, 6, n)]
    else:
        u = np.tile([0.6, 0.0, 0.8], (n, 1))
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    return u if motion in ("tumble", "six faces") else u @ frame.T


@dataclass(frozen=True)
class Mission:
    """Simulated samples and the sensor that made them."""

    samples: Samples
    sensor: SensorModel

    @property
    def truth(self) -> NDArray[np.float64]:
        return np.concatenate([self.sensor.bias_nt, self.sensor.scale, self.sensor.nonorthogonality_deg])


def fly(  # noqa: PLR0917
    motion: str = "tumble",
    n: int = 700,
    noise_nt: float = 100.0,
    seed: int = 1,
    sensor: SensorModel = TABLE_1,
    constant_nt: float | None = None,
    axial_nt: float | None = None,
    rate_deg_s: float = 0.76,
) -> Mission:
    """Simulate a mission over a dipole field: |B| 22-46 uT over a 5700 s orbit, or constant."""
    rng = np.random.default_rng(seed)
    phase = 2 * np.pi * np.arange(n) / 570.0
    magnitude = np.full(n, constant_nt) if constant_nt else 23000.0 * np.sqrt(1 + 2.9 * np.sin(phase) ** 2)
    b_nt = directions(motion, n, rng, rate_deg_s) * magnitude[:, None]
    if axial_nt is not None:
        turn = np.deg2rad(0.76) * 10.0 * np.arange(n)
        across = np.sqrt(magnitude**2 - axial_nt**2)
        b_nt = np.c_[across * np.cos(turn), np.full(n, axial_nt), across * np.sin(turn)]
    t_utc = np.datetime64("2022-02-19T22:37:44", "ns") + np.arange(n) * np.timedelta64(10, "s")
    h_nt = sensor.apply(b_nt) + noise_nt * rng.normal(size=(n, 3))
    magnitude = np.linalg.norm(b_nt, axis=1)
    return Mission(Samples(t_utc, h_nt, b_ref_base_nt=b_nt, b_ref_magnitude_nt=magnitude), sensor)


@pytest.fixture(scope="session")
def mission() -> Callable[..., Mission]:
    return fly


@pytest.fixture(scope="session")
def hard_sensor() -> Callable[[int], SensorModel]:
    """Sensors far from ideal: gains 0.3 to 3, axes up to 50 deg off, offsets larger than the field."""

    def make(seed: int) -> SensorModel:
        rng = np.random.default_rng(seed)
        return SensorModel(rng.uniform(-6e4, 6e4, 3), rng.uniform(0.3, 3.0, 3), rng.uniform(-50, 50, 3))

    return make

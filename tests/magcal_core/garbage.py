"""Sessions with rows that are no readings: kinds that operators send, and kinds that no page names."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magcal_core.samples import Samples

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Spoiler:
    """Draws for one session: scattered rows, a stretch, an axis."""

    rng: np.random.Generator
    h: Floats
    b_base_nt: Floats
    matrix: Floats
    bias_nt: Floats
    count: int

    @property
    def scattered(self) -> NDArray[np.intp]:
        return self.rng.choice(len(self.h), self.count, replace=False)

    @property
    def stretch(self) -> NDArray[np.intp]:
        first = self.rng.integers(0, len(self.h) - self.count + 1)
        return np.arange(first, first + self.count)

    @property
    def axis(self) -> int:
        return int(self.rng.integers(3))


def _filled(value: float) -> Callable[[Spoiler], NDArray[np.intp]]:
    def spoil(s: Spoiler) -> NDArray[np.intp]:
        rows = s.scattered
        s.h[rows] = value
        return rows

    return spoil


def _spiked(size_nt: float) -> Callable[[Spoiler], NDArray[np.intp]]:
    def spoil(s: Spoiler) -> NDArray[np.intp]:
        rows, away = s.scattered, s.rng.normal(size=(s.count, 3))
        s.h[rows] += size_nt * away / np.linalg.norm(away, axis=1, keepdims=True)
        return rows

    return spoil


def _stuck(s: Spoiler) -> NDArray[np.intp]:
    rows = s.stretch
    s.h[rows] = s.h[rows[0]]
    return rows


def _offset(s: Spoiler) -> NDArray[np.intp]:
    rows, away = s.stretch, s.rng.normal(size=3)
    s.h[rows] += s.rng.uniform(4000, 30000) * away / np.linalg.norm(away)
    return rows


def _axis_stuck(s: Spoiler) -> NDArray[np.intp]:
    rows, axis = s.stretch, s.axis
    s.h[rows, axis] = s.h[rows[0], axis]
    return rows


def _swapped(s: Spoiler) -> NDArray[np.intp]:
    rows, axis = s.stretch, s.axis
    pair = [axis, (axis + 1) % 3]
    s.h[np.ix_(rows, pair)] = s.h[np.ix_(rows, pair[::-1])]
    return rows


def _inverted(s: Spoiler) -> NDArray[np.intp]:
    rows, axis = s.stretch, s.axis
    s.h[rows, axis] *= -1.0
    return rows


def _clipped(s: Spoiler) -> NDArray[np.intp]:
    axis = s.axis
    limit = round(float(np.quantile(np.abs(s.h[:, axis]), 1.0 - s.count / len(s.h))), 1)
    rows = np.flatnonzero(np.abs(s.h[:, axis]) >= limit)
    s.h[:, axis] = np.clip(s.h[:, axis], -limit, limit)
    return rows


def _counter(s: Spoiler) -> NDArray[np.intp]:
    rows, axis = s.stretch, s.axis
    s.h[rows, axis] = np.arange(len(rows))
    return rows


def _interleaved(s: Spoiler) -> NDArray[np.intp]:
    rows = s.scattered
    other = s.matrix * s.rng.uniform(0.8, 1.2, (3, 1))
    s.h[rows] = s.b_base_nt[rows] @ other.T + s.rng.uniform(-20000, 20000, 3)
    return rows


def _other_day(s: Spoiler) -> NDArray[np.intp]:
    rows = s.scattered
    far = (rows + len(s.h) // 2 + s.rng.integers(-40, 40, len(rows))) % len(s.h)
    s.h[rows] = s.b_base_nt[far] @ s.matrix.T + s.bias_nt
    return rows


def _scaled_copy(s: Spoiler) -> NDArray[np.intp]:
    rows, axis = s.scattered, s.axis
    s.h[rows] = s.h[np.maximum(rows - 1, 0)]
    s.h[rows, axis] *= s.rng.choice([0.5, 1.5, 2.0])
    return rows


def _random(s: Spoiler) -> NDArray[np.intp]:
    rows = s.scattered
    s.h[rows] = s.rng.uniform(-60000, 60000, (len(rows), 3))
    return rows


KINDS: dict[str, Callable[[Spoiler], NDArray[np.intp]]] = {
    "zeros": _filled(0.0),
    "fill -999": _filled(-999.0),
    "fill 32767": _filled(32767.0),
    "fill 1e31": _filled(1e31),
    "spikes of 3 uT": _spiked(3e3),
    "spikes of 10 uT": _spiked(1e4),
    "spikes of 200 uT": _spiked(2e5),
    "stuck": _stuck,
    "stretch with an offset": _offset,
    "axis stuck": _axis_stuck,
    "axes swapped": _swapped,
    "axis inverted": _inverted,
    "clipped": _clipped,
    "counter for an axis": _counter,
    "two sensors interleaved": _interleaved,
    "rows of another day": _other_day,
    "rows repeated with one axis scaled": _scaled_copy,
    "random numbers": _random,
}
SCREENED = frozenset({"zeros", "fill -999", "fill 32767", "fill 1e31", "stuck", "clipped"})
"""Kinds that the screen alone keeps out."""


def spoiled(mission: object, kind: str, share: float, seed: int) -> tuple[Samples, NDArray[np.bool_]]:
    """Return the samples of ``mission``, to 0.1 nT, with a ``share`` of bad rows of one kind, and which these are."""
    samples, sensor = mission.samples, mission.sensor  # type: ignore[attr-defined]
    h = np.round(samples.h_nt, 1)
    count = round(share * len(h))
    spoiler = Spoiler(np.random.default_rng([seed, 7]), h, samples.b_ref_base_nt, sensor.matrix, sensor.bias_nt, count)
    is_bad = np.zeros(len(h), dtype=bool)
    if count:
        is_bad[KINDS[kind](spoiler)] = True
    fine = h if kind == "fill 1e31" else np.round(h, 1)
    return replace(samples, h_nt=fine), is_bad

"""Slow waves of the bias that the residuals of a fit show: beside them, what an offset of the clock does is seen.

Notes
-----
Heat and currents change with the orbit, and so does the field: a bias that swings once per orbit is nearly what a clock
that is off does to |B|. To the fit such a wave is an error with a long memory, whose honest interval is several times
wider than need be; named as an unknown, it is none. Frequencies from half a wave a session on are tried, the best one
is taken as long as it shows, and each is sought between the steps as well. What goes on showing after some waves has no
period: a memory without one is left to the honest errors, since waves would take of it only what they were chosen for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.observations import Observations
from magcal_core.sensor.correction import correct, readings_without
from magcal_core.sensor.model import inverse_lower
from magcal_core.sensor.regressors import term_nt

Waves = NDArray[np.complex128]

SHORTEST_S: Final = 1800.0
"""Shortest period that is tried, s: a third of a low orbit."""
CHANCE: Final = 1e-3
"""Probability with which white noise shows a wave, over all frequencies."""
MOST_WAVES: Final = 3
"""Waves beyond which the residuals are of another kind."""
_STEP_CYCLES: Final = 0.5
"""Step between the frequencies that are tried, in waves a session: nearer ones are the same to it."""
_BETWEEN_CYCLES: Final = (-0.375, -0.25, -0.125, 0.0, 0.125, 0.25, 0.375)
_SEEN_BETWEEN: Final = 0.7
"""Share of what a wave explains that is seen from the nearest step: a quarter of a wave off, 0.8."""
_MOST_FREQUENCIES: Final = 400
_MOST_SAMPLES: Final = 4000
_AT_ONCE: Final = 32
_RIDGE: Final = 1e-3
"""Share of a wave below which what the fit has left of it counts for less: next to nothing is no evidence."""
_NOTHING: Final = 1e-10
_SAMPLES_A_COLUMN: Final = 10
"""Fewest samples for each column: fewer leave nothing to be told from."""


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    """One residual with what may explain it: all times the root of the weights.

    Attributes
    ----------
    residual : shape (n,)
        Residual, nT.
    base : shape (n, q)
        Orthonormal columns of what the fit has taken up already.
    carriers : shape (n, k)
        Change of the residual by the bias along the axes that reach it.
    """

    residual: Floats
    base: Floats
    carriers: Floats

    def explained(self, waves: Waves) -> Floats:
        """Return the sums of squares, shape (m,), nT^2, that each of the ``waves``, shape (m, n), takes."""
        columns = self._columns(waves)
        slopes, shared = columns @ self.residual, columns @ self.base
        normals = columns @ columns.swapaxes(1, 2)
        size = np.sqrt(np.diagonal(normals, axis1=1, axis2=2))
        normals -= shared @ shared.swapaxes(1, 2)
        slopes /= size
        normals /= size[:, :, None] * size[:, None, :]
        normals += _RIDGE * np.eye(normals.shape[1])
        return np.asarray(np.sum(slopes * np.linalg.solve(normals, slopes[:, :, None])[:, :, 0], axis=1))

    def without(self, wave: Waves) -> _Channel:
        """Return the channel with the one ``wave``, shape (1, n), among the things taken up."""
        columns = self._columns(wave)[0].T
        rest = _orthonormal(columns - self.base @ (self.base.T @ columns))
        left = self.residual - rest @ (rest.T @ self.residual)
        return _Channel(left, np.column_stack([self.base, rest]), self.carriers)

    def _columns(self, waves: Waves) -> Floats:
        """Return what waves of the bias do to the residual, shape (m, 2 k, n)."""
        (m, n), k = waves.shape, self.carriers.shape[1]
        columns, carriers = np.empty((m, 2 * k, n)), np.ascontiguousarray(self.carriers.T)
        np.multiply(carriers, waves.real[:, None], out=columns[:, :k])
        np.multiply(carriers, waves.imag[:, None], out=columns[:, k:])
        return columns


def slow_waves(observations: Observations, fit: Fit) -> tuple[float, ...]:
    """Return the periods, s, of the waves of the bias that explain what ``fit`` has left, the strongest first.

    None where nothing slow is left, and none where waves do not explain it.

    ``observations``: those of the fit, with the derivative of the reference by the clock where that was an
    unknown.
    """
    step = max(1, -(-len(observations) // _MOST_SAMPLES))
    t_s = observations.t_s[::step]
    span_s = float(t_s[-1] - t_s[0])
    cycles = np.arange(_STEP_CYCLES, span_s / SHORTEST_S, _STEP_CYCLES)[:_MOST_FREQUENCIES]
    channels = [*_channels(observations.take(slice(None, None, step)), fit, step)]
    if not cycles.size or len(t_s) < _SAMPLES_A_COLUMN * (channels[0].base.shape[1] + 6 * MOST_WAVES):
        return ()
    turns = 2.0 * np.pi * (t_s - t_s[0]) / span_s
    limit = _limit(len(cycles))
    periods: list[float] = []
    while len(periods) <= MOST_WAVES:
        roughly = _explained(channels, turns, cycles)
        if roughly.max() < _SEEN_BETWEEN * limit * _variance(channels):
            return tuple(periods)
        near = cycles[int(np.argmax(roughly))] + np.array(_BETWEEN_CYCLES)
        explained = _explained(channels, turns, near)
        best = float(near[int(np.argmax(explained))])
        after = [channel.without(_waves(turns, np.array([best]))) for channel in channels]
        if explained.max() < limit * _variance(after):
            return tuple(periods)
        periods.append(span_s / best)
        channels = after
    return ()


def wave_columns(t_s: Floats, periods_s: tuple[float, ...]) -> dict[str, Floats]:
    """Return the regressors of waves of ``periods_s``, s, at ``t_s``: their mean over the session is taken off."""
    made = {}
    for i, period_s in enumerate(periods_s):
        phase = 2.0 * np.pi * t_s / period_s
        for name, column in (("cos", np.cos(phase)), ("sin", np.sin(phase))):
            made[f"bias wave {i}, {name}"] = column - column.mean()
    return made


def _explained(channels: list[_Channel], turns: Floats, cycles: Floats) -> Floats:
    """Return what waves of ``cycles``, shape (m,), a session take from all channels, shape (m,), nT^2.

    The ``cycles`` are evenly spaced.
    """
    found = []
    for part in np.array_split(cycles, -(-len(cycles) // _AT_ONCE)):
        waves = _waves(turns, part)
        found.append(sum(one.explained(waves) for one in channels))
    return np.concatenate(found)


def _waves(turns: Floats, cycles: Floats) -> Waves:
    """Return cosine and sine, shape (m, n), of evenly spaced multiples of ``turns``, shape (n,), rad."""
    waves = np.empty((len(cycles), len(turns)), np.complex128)
    waves[0] = np.exp(1j * cycles[0] * turns)
    if len(cycles) > 1:
        step = np.exp(1j * (cycles[1] - cycles[0]) * turns)
        for i in range(1, len(cycles)):
            np.multiply(waves[i - 1], step, out=waves[i])
    return waves


def _variance(channels: list[_Channel]) -> float:
    """Return the variance of what is left, nT^2."""
    left = sum(float(channel.residual @ channel.residual) for channel in channels)
    freedom = sum(channel.residual.size - channel.base.shape[1] for channel in channels)
    return float(left / freedom)


def _limit(frequencies: int) -> float:
    """Return the sum of squares, in variances, that six columns reach with `CHANCE` at one of ``frequencies``."""
    from scipy.special import chdtri

    return float(chdtri(6, CHANCE / frequencies))


def _channels(o: Observations, fit: Fit, step: int) -> Iterator[_Channel]:
    """Yield what is distinguished: |B|, or the sensor's axes one after the other, of every ``step``-th sample."""
    residual, root = fit.residuals_nt[::step], np.sqrt(fit.weights[::step])
    matrix = fit.parameters.matrix
    reading = readings_without(o.regressors, o.h_nt, fit.parameters)
    ones, columns = np.ones((len(o), 1)), list(o.regressors.values())
    if residual.ndim == 1:
        lower = inverse_lower(matrix)
        corrected = correct(reading, fit.parameters.bias_nt, lower)
        along = corrected / np.linalg.norm(corrected, axis=1)[:, None]
        rows, entries = np.tril_indices(3)
        base = [along[:, rows] * reading[:, entries], along, o.rate_nt_s]
        base += [term_nt(column, np.ones(3)) * (along @ lower) for column in columns]
        yield _weighed(residual, np.column_stack(base), along, root)
        return
    field_nt, along_axes = o.require_vector(), residual @ matrix.T
    for axis in range(3):
        base = [field_nt[:, : axis + 1], ones, *(term_nt(column, np.ones(3))[:, axis] for column in columns)]
        if o.rate_base_nt_s is not None:
            base.append(o.rate_base_nt_s @ matrix[axis])
        yield _weighed(along_axes[:, axis], np.column_stack(base), ones, root)


def _weighed(residual: Floats, base: Floats, carriers: Floats, root: Floats) -> _Channel:
    weighed = root[:, None] * base
    basis = _orthonormal(weighed / np.maximum(np.linalg.norm(weighed, axis=0), 1e-300))
    left = root * residual
    return _Channel(left - basis @ (basis.T @ left), basis, root[:, None] * carriers)


def _orthonormal(columns: Floats) -> Floats:
    """Return orthonormal columns that span ``columns``, shape (n, k), but for what is next to nothing of them."""
    sizes, turns = np.linalg.eigh(columns.T @ columns)
    is_told = sizes > _NOTHING * sizes[-1]
    return np.asarray(columns @ (turns[:, is_told] / np.sqrt(sizes[is_told])))

"""Payload and coil steps: the offset of a device that switches on and off, estimated from the jumps themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.uncertainty.honest_covariance import student_95
from magcal_core.errors import NotObservableError, OptionError
from magcal_core.numerics.robust import robust_sigma, weights_and_slopes
from magcal_core.observations import Observations, corrected_nt, residuals_nt
from magcal_core.sensor.model import inverse_lower
from magcal_core.sensor.parameters import Parameters

WINDOW_S: Final = 300.0
"""Reach of the data used on either side of a jump, s: short against the orbit, so that drifts are straight lines."""
MIN_SIDE: Final = 2
"""Samples that a jump needs on either side."""
MIN_TRANSITIONS: Final = 2
_MOST_LEVELS: Final = 3
_CONDITION: Final = 1e4
_ROUNDS: Final = 10
_ENOUGH_FOR_A_LINE: Final = 24


@dataclass(frozen=True, slots=True, eq=False)
class DeviceStep:
    """What one device adds to the reading when its column goes up by one unit.

    Attributes
    ----------
    offset_nt, standard_errors_nt : shape (3,)
        Along the sensor's axes, nT per unit of the column; honest (jumps weighed against one another).
    covariance_nt2 : shape (3, 3)
    transitions, samples : jumps and samples used.
    p_value : probability of an offset so large where there is none.
    """

    device: str
    offset_nt: Floats
    standard_errors_nt: Floats
    covariance_nt2: Floats
    transitions: int
    samples: int
    p_value: float

    @property
    def is_significant(self) -> bool:
        """Whether the device is seen at all."""
        return self.p_value < 0.01

    @property
    def text(self) -> str:
        """The offset in words, as flight software may be given."""
        parts = [f"{b:+.0f} +- {e:.0f}" for b, e in zip(self.offset_nt, self.standard_errors_nt, strict=True)]
        seen = "" if self.is_significant else ": not significant"
        return f"{self.device} adds ({', '.join(parts)}) nT a unit, from {self.transitions} jumps{seen}"

    def to_dict(self) -> dict[str, object]:
        """Return the step as records have it."""
        return {
            "device": self.device,
            "offset_nt": self.offset_nt.tolist(),
            "standard_errors_nt": self.standard_errors_nt.tolist(),
            "covariance_nt2": self.covariance_nt2.tolist(),
            "transitions": self.transitions,
            "samples": self.samples,
            "p_value": self.p_value,
            "is_significant": self.is_significant,
            "text": self.text,
        }


def switching_columns(housekeeping: Mapping[str, Floats]) -> tuple[str, ...]:
    """Return the columns that look like a device's state: two or three values, and at least `MIN_TRANSITIONS` jumps."""
    found = []
    for name, column in housekeeping.items():
        known = column[np.isfinite(column)]
        if known.size and len(np.unique(known)) in range(2, _MOST_LEVELS + 1):
            jumps = np.count_nonzero(np.diff(known))
            if MIN_TRANSITIONS <= jumps <= known.size / (2 * MIN_SIDE):
                found.append(name)
    return tuple(found)


def device_step(
    observations: Observations, parameters: Parameters, device: str, *, is_vector: bool, window_s: float = WINDOW_S
) -> DeviceStep:
    """Return the offset of one device from its jumps.

    Parameters
    ----------
    observations : Observations
        With the device's column among the regressors; other regressors of ``parameters`` are taken off.
    parameters : Parameters
        A calibration; whether the device was among its regressors does not matter.
    device : str
        Name of the column: 0 and 1, or any levels.
    is_vector : bool
        Use the components of the residual, else |corrected| - |model| alone.
    window_s : float
        Reach on either side of a jump, s.

    Raises
    ------
    OptionError
        There is no such column.
    NotObservableError
        Too few jumps, or jumps that do not show all three components (|B| sees one component at a time).

    Notes
    -----
    Around each jump, within ``window_s`` and no further than half way to the next jump, the bias is taken for a
    constant, a straight line and the device: r = g.(d s + c + e t), g = 1 for a component of the reading, g = T^-T u
    for |B| with u the direction of the corrected reading. c and e, vectors, are the window's own and are eliminated.
    Huber's loss. Errors come from the windows as independent blocks, each weighed as if it were left out, with
    Student's t; they are never below those of white noise.
    """
    if device not in observations.regressors:
        raise OptionError(
            f"no housekeeping column {device!r}; there are {', '.join(observations.regressors) or 'none'}"
        )
    state = observations.regressors[device]
    rows, residuals = _rows(observations, parameters, device, is_vector=is_vector)
    windows = _windows(observations.t_s, state, window_s)
    if len(windows) < MIN_TRANSITIONS:
        raise NotObservableError(
            f"{device}: {len(windows)} jumps with {MIN_SIDE} samples on either side, {MIN_TRANSITIONS} are needed",
            [f"regressors.{device}"],
        )
    return _estimate(_Jumps(device, observations.t_s, state, rows, residuals, observations.weights, windows))


def device_steps(
    observations: Observations, parameters: Parameters, devices: Sequence[str], *, is_vector: bool
) -> tuple[tuple[DeviceStep, ...], tuple[str, ...]]:
    """Return the steps of several devices, and a warning for each that its jumps do not show."""
    found, warnings = [], []
    for device in devices:
        try:
            found.append(device_step(observations, parameters, device, is_vector=is_vector))
        except NotObservableError as error:
            warnings.append(f"device_not_observable: {error.message}")
    return tuple(found), tuple(warnings)


def steps_of(
    observations: Observations, housekeeping: Mapping[str, Floats], parameters: Parameters, *, is_vector: bool
) -> tuple[tuple[DeviceStep, ...], tuple[str, ...]]:
    """Return the steps of every housekeeping column that looks like a device's state, and warnings.

    ``housekeeping``: columns at the observations' own samples; incomplete ones are passed over.
    """
    complete = {name: column for name, column in housekeeping.items() if np.isfinite(column).all()}
    devices = switching_columns(complete)
    if not devices:
        return (), ()
    columns = {**observations.regressors, **{name: complete[name] for name in devices}}
    return device_steps(replace(observations, regressors=columns), parameters, devices, is_vector=is_vector)


def _rows(o: Observations, parameters: Parameters, device: str, *, is_vector: bool) -> tuple[Floats, Floats]:
    """Return how a unit offset (of each axis) moves each residual, shape (n, m, 3), and the residuals, shape (n, m)."""
    others = {name: slope for name, slope in parameters.regressors.items() if name != device}
    bare = Parameters(parameters.bias_nt, parameters.scale, parameters.nonorthogonality_deg, None, others)
    matrix = parameters.matrix
    # The calibration's own estimate of the device stays in the bias it was made with: only jumps count here.
    if is_vector:
        r = residuals_nt(o, bare, is_vector=True)
        return np.broadcast_to(np.eye(3), (len(o), 3, 3)), r @ matrix.T
    x = corrected_nt(o, bare)
    u = x / np.linalg.norm(x, axis=1, keepdims=True)
    return (u @ inverse_lower(matrix))[:, None, :], residuals_nt(o, bare, is_vector=False)[:, None]


def _windows(t_s: Floats, state: Floats, window_s: float) -> list[NDArray[np.intp]]:
    """Return the samples around each jump that has enough of them on either side."""
    jumps = np.flatnonzero(np.diff(state) != 0)
    at = 0.5 * (t_s[jumps] + t_s[jumps + 1])
    edges = np.concatenate([[-np.inf], 0.5 * (at[1:] + at[:-1]), [np.inf]])
    windows = []
    for k, middle in enumerate(at):
        low, high = max(edges[k], middle - window_s), min(edges[k + 1], middle + window_s)
        index = np.flatnonzero((t_s >= low) & (t_s <= high))
        if min(np.count_nonzero(t_s[index] < middle), np.count_nonzero(t_s[index] > middle)) >= MIN_SIDE:
            windows.append(index)
    return windows


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """The residuals around the jumps of one device."""

    device: str
    t_s: Floats
    state: Floats
    rows: Floats
    residuals: Floats
    weights: Floats
    windows: list[NDArray[np.intp]]

    def parts(self, weights: Floats) -> list[tuple[Floats, Floats, Floats]]:
        """Return design, residual and root weight of every window with offset and line eliminated."""
        return [self._part(index, weights[index]) for index in self.windows]

    def _part(self, index: NDArray[np.intp], weights: Floats) -> tuple[Floats, Floats, Floats]:
        t = self.t_s[index] - self.t_s[index].mean()
        rows = self.rows[index]
        n, m = rows.shape[:2]
        # With few samples a line would take the jump with it.
        order = 1 if n * m >= _ENOUGH_FOR_A_LINE else 0
        root = np.repeat(np.sqrt(weights), m)[:, None]
        trend = np.concatenate([rows * (t**k)[:, None, None] for k in range(order + 1)], axis=2).reshape(n * m, -1)
        q = np.linalg.qr(trend / np.maximum(np.abs(trend).max(axis=0), 1e-300) * root)[0]
        left = (rows * self.state[index][:, None, None]).reshape(n * m, 3) * root
        right = self.residuals[index].reshape(n * m) * root[:, 0]
        return left - q @ (q.T @ left), right - q @ (q.T @ right), root[:, 0]


def _estimate(jumps: _Jumps) -> DeviceStep:
    from scipy.special import chdtrc

    weights = jumps.weights
    used = np.unique(np.concatenate(jumps.windows))
    for _ in range(_ROUNDS):
        parts = jumps.parts(weights)
        normals = np.stack([left.T @ left for left, _, _ in parts])
        normal = normals.sum(axis=0)
        if np.linalg.cond(normal) > _CONDITION:
            raise NotObservableError(
                f"{jumps.device}: its {len(parts)} jumps do not show all three components of its offset",
                [f"regressors.{jumps.device}"],
            )
        offset = np.linalg.solve(normal, np.sum([left.T @ right for left, right, _ in parts], axis=0))
        errors = [right - left @ offset for left, right, _ in parts]
        plain = np.concatenate([e / np.maximum(root, 1e-9) for e, (_, _, root) in zip(errors, parts, strict=True)])
        sigma = robust_sigma(plain, 1e-9)
        weights = jumps.weights.copy()
        for index, e, (_, _, root) in zip(jumps.windows, errors, parts, strict=True):
            worst = np.abs((e / np.maximum(root, 1e-9)).reshape(len(index), -1)).max(axis=1)
            weights[index] = jumps.weights[index] * weights_and_slopes(worst, "huber", sigma)[0]
    covariance = _covariance(normals, parts, errors, 6 * len(parts))
    statistic = float(offset @ np.linalg.solve(covariance, offset))
    return DeviceStep(
        device=jumps.device,
        offset_nt=offset,
        standard_errors_nt=np.sqrt(np.diag(covariance)),
        covariance_nt2=covariance,
        transitions=len(parts),
        samples=len(used),
        p_value=float(chdtrc(3, statistic)),
    )


def _covariance(
    normals: Floats, parts: list[tuple[Floats, Floats, Floats]], errors: list[Floats], eliminated: int
) -> Floats:
    """Return the honest covariance: windows left out one by one, never below white noise."""
    total, count = normals.sum(axis=0), len(parts)
    dof = max(float(sum(e.size for e in errors)) - eliminated - 3.0, 1.0)
    white = np.linalg.inv(total) * float(sum(e @ e for e in errors)) / dof
    if count < 3:
        return white * (student_95(count - 1) / 1.96) ** 2
    shifts = []
    for normal, (left, _, _), e in zip(normals, parts, errors, strict=True):
        rest = total - normal
        values, vectors = np.linalg.eigh(rest)
        inverse = (vectors / np.maximum(values, 1e-9 * values[-1])) @ vectors.T
        shifts.append(inverse @ (left.T @ e))
    spread = np.stack(shifts)
    honest = spread.T @ spread * (count - 1) / count * (student_95(count - 1) / 1.96) ** 2
    raise_by = np.sqrt(np.maximum(1.0, np.diag(white) / np.maximum(np.diag(honest), 1e-300)))
    return np.asarray(honest * np.outer(raise_by, raise_by))

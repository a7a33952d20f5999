"""How the magnetometer lies to the gyros, and its handedness, without attitude: two sensors that see one motion.

Notes
-----
x = s R C B: x the corrected reading, B the inertial field, C the attitude of the gyro axes, R proper, s = -1 where the
magnetometer's axes are a left-handed set. Within a window C_i = F_i C_0 with F from the gyros, and C_0 is what fits the
window best (singular value decomposition, proper). R and the gyros' bias are found on the residuals of all windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector
from magcal_core.calibration.uncertainty.honest_covariance import student_95
from magcal_core.numerics.kernel import kernel
from magcal_core.numerics.levenberg_marquardt import minimise
from magcal_core.numerics.linear_algebra import unit_diagonal

Ints = NDArray[np.intp]

WINDOW_S: Final = 1200.0
"""Longest window: errors of the readings bias short ones, errors of the gyros long ones."""
SLOW_WINDOW_S: Final = 3000.0
"""Longest window of a satellite that rotates slowly."""
HAND_WINDOW_S: Final = 6000.0
TURN_DEG: Final = 60.0
LEAST_TURN_DEG: Final = 45.0
APART_DEG: Final = 6.0
ALIKE: Final = 1.3
UNCERTAIN_DEG: Final = 3.0
HAND_RATIO: Final = 2.0
_START_S: Final = 60.0
_START_WINDOWS: Final = 40
_MOST_WINDOWS: Final = 64
_FEWEST: Final = 10
_FEWEST_AT_START: Final = 8
_BREAK: Final = 2.5
_ROUNDS: Final = 15
_STILL: Final = 1e-6
_ROUNDS_ON_THE_WAY: Final = 4
_SMALL_RAD: Final = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class GyroSession:
    """Corrected readings beside gyros.

    Attributes
    ----------
    t_s : shape (n,)
        Times, s, ascending.
    x_nt, b_nt : shape (n, 3)
        Corrected reading, base frame, and inertial field (GCRF), nT.
    rate_rad_s : shape (n, 3)
        Angular rate along the gyro axes, rad/s.
    weights : shape (n,)
        Zero for readings that do not count; their gyros do.
    """

    t_s: Floats
    x_nt: Floats
    b_nt: Floats
    rate_rad_s: Floats
    weights: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GyroMounting:
    """The rotation from the gyro axes to the magnetometer's base frame; figures are None where it is ``refused``."""

    state: str
    reason: str | None = None
    rotation: Floats | None = None
    rotation_vector_deg: Floats | None = None
    standard_errors_deg: Floats | None = None
    handedness: str | None = None
    handedness_ratio: float | None = None
    bias_deg_s: Floats | None = None
    bias_errors_deg_s: Floats | None = None
    window_s: float | None = None
    windows: int | None = None
    rms_deg: float | None = None

    def to_dict(self) -> dict[str, object]:
        """Return the mounting as the records have it."""
        found: dict[str, object] = {}
        for name in self.__slots__:
            value = getattr(self, name)
            found[name] = value.tolist() if isinstance(value, np.ndarray) else value
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """An estimate: R, the gyros' bias, rad/s, and the mean square of the residuals over the field's."""

    rotation: Floats
    bias: Floats
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """The samples of some windows, one after another; ``firsts``: where each begins, shape (w,)."""

    session: GyroSession
    firsts: Ints
    sign: float

    @property
    def scale_nt(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.session.b_nt**2, axis=1))))

    def residuals(self, rotation: Floats, bias: Floats) -> Floats:
        """Return x - s R F C_0 B over the field, shape (n, 3), zero where a reading does not count."""
        return self.seen(self.turns(bias), rotation)

    def turns(self, bias: Floats) -> Floats:
        """Return F of every sample, shape (n, 3, 3), with the gyros' bias, rad/s, taken off."""
        return np.asarray(_turns(self.session.t_s, self.session.rate_rad_s - bias, self.firsts))

    def seen(self, turned: Floats, rotation: Floats) -> Floats:
        """Return the residuals, shape (n, 3), where F is known already."""
        s = self.session
        own = self.sign * np.einsum("nji,nj->ni", turned, s.x_nt @ rotation)
        outer = (s.weights > 0)[:, None, None] * own[:, :, None] * s.b_nt[:, None, :]
        u, _, v = np.linalg.svd(np.add.reduceat(outer, self.firsts, axis=0))
        hand = np.sign(np.linalg.det(u @ v))
        u[:, :, 2] *= hand[:, None]
        first = np.repeat(u @ v, np.diff(np.append(self.firsts, len(s.t_s))), axis=0)
        inside = np.einsum("njk,nk->nj", turned, np.einsum("nkl,nl->nk", first, s.b_nt))
        model = self.sign * inside @ rotation.T
        return np.asarray((s.weights > 0)[:, None] * (s.x_nt - model) / self.scale_nt)

    def cost(self, rotation: Floats, bias: Floats) -> float:
        r = self.residuals(rotation, bias)
        return float(np.sum(r**2)) / max(int(np.count_nonzero(self.session.weights > 0)), 1)

    def derivatives(self, start: Floats, unknowns: Floats, window_s: float) -> tuple[Floats, Floats]:
        """Return the residuals, shape (n, 3), and their derivatives by the unknowns, shape (6, n, 3).

        ``unknowns``: the turn of R from ``start``, rad, and the bias, rad/s.
        """
        turn, bias = unknowns[:3], unknowns[3:]
        turned, found = self.turns(bias), []
        rotation = _turned(start, turn)
        here = self.seen(turned, rotation)
        for axis in np.eye(3):
            found.append((self.seen(turned, _turned(start, turn + _SMALL_RAD * axis)) - here) / _SMALL_RAD)
        step = _SMALL_RAD / window_s
        for axis in np.eye(3):
            found.append((self.residuals(rotation, bias + step * axis) - here) / step)
        return here, np.array(found)

    def refined(self, start: _State, window_s: float, rounds: int = _ROUNDS) -> _State:
        """Return the minimum near ``start``, by Levenberg-Marquardt."""

        def evaluate(unknowns: Floats, normal: Floats, gradient: Floats) -> float:
            r, j = self.derivatives(start.rotation, unknowns, window_s)
            columns = j.reshape(6, -1)
            normal[:], gradient[:] = columns @ columns.T, columns @ r.ravel()
            return float(np.sum(r**2))

        begin = np.concatenate([np.zeros(3), start.bias])
        found = minimise(evaluate, begin, np.sqrt(len(self.session.t_s)), limit=rounds + 1, still=_STILL)
        count = max(int(np.count_nonzero(self.session.weights > 0)), 1)
        return _State(_turned(start.rotation, found.theta[:3]), found.theta[3:], found.cost / count)


def _turned(rotation: Floats, vector_rad: Floats) -> Floats:
    return np.asarray(attitude_matrix(from_rotation_vector(vector_rad)) @ rotation)


@kernel()
def _turns(t_s: Floats, rate: Floats, firsts: Ints) -> Floats:  # pragma: no cover - compiled
    """Return F of each sample, shape (n, 3, 3): C_i = F_i C_0 since the first sample of its window.

    Each column of F turns by exp(-[v x]): f - sin(a)/a v x f + (1 - cos a)/a^2 v x (v x f), a = |v|.
    """
    n = t_s.size
    found = np.zeros((n, 3, 3))
    v, across, twice = np.empty(3), np.empty(3), np.empty(3)
    window = 0
    for i in range(n):
        if window < firsts.size and firsts[window] == i:
            window += 1
            for k in range(3):
                found[i, k, k] = 1.0
            continue
        dt = t_s[i] - t_s[i - 1]
        square = 0.0
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            turn = rate[i - 1, p] * rate[i, q] - rate[i - 1, q] * rate[i, p]
            v[k] = 0.5 * (rate[i - 1, k] + rate[i, k]) * dt + turn * dt * dt / 12.0
            square += v[k] * v[k]
        angle = np.sqrt(square)
        first = 1.0 if angle < 1e-9 else np.sin(angle) / angle
        second = 0.5 if angle < 1e-6 else (1.0 - np.cos(angle)) / square
        for column in range(3):
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                across[k] = v[p] * found[i - 1, q, column] - v[q] * found[i - 1, p, column]
            for k in range(3):
                p, q = (k + 1) % 3, (k + 2) % 3
                twice[k] = v[p] * across[q] - v[q] * across[p]
            for k in range(3):
                found[i, k, column] = found[i - 1, k, column] - first * across[k] + second * twice[k]
    return found


def gyro_mounting(session: GyroSession) -> GyroMounting:
    """Return how the magnetometer's base frame lies to the gyro axes, and whether its axes are a left-handed set."""
    stretches = _stretches(session.t_s)
    covered_s = sum(float(session.t_s[j - 1] - session.t_s[i]) for i, j in stretches)
    speed = float(np.median(np.linalg.norm(session.rate_rad_s, axis=1)))
    window_s = _window_s(covered_s, speed, session)
    found = {sign: _best(session, stretches, window_s, sign) for sign in (1.0, -1.0)}
    if any(not some for some in found.values()):
        return GyroMounting("refused", "few_windows")
    hands = {sign: _long_cost(session, stretches, covered_s, some[0], sign) for sign, some in found.items()}
    sign = min(hands, key=lambda one: hands[one])
    ratio = hands[-sign] / max(hands[sign], 1e-300)
    handedness = "unknown" if ratio < HAND_RATIO else "right" if sign > 0 else "left"
    best, *others = found[sign]
    windows = _windows(session, stretches, window_s, sign, _FEWEST, _MOST_WINDOWS)
    count = len(windows.firsts)
    if count < 2:
        return GyroMounting("refused", "few_windows", handedness=handedness, handedness_ratio=ratio)
    told = GyroMounting(
        "refused", None, handedness=handedness, handedness_ratio=ratio, window_s=window_s, windows=count
    )
    turn_deg = np.rad2deg(np.median(np.linalg.norm(session.rate_rad_s - best.bias, axis=1))) * window_s
    if turn_deg < LEAST_TURN_DEG:
        return replace(told, reason="too_slow")
    if any(_apart_deg(one, best) > APART_DEG and one.cost <= ALIKE * best.cost for one in others):
        return replace(told, reason="ambiguous")
    errors = _errors(windows, best, window_s)
    if not np.isfinite(errors).all() or np.rad2deg(np.linalg.norm(errors[:3])) > UNCERTAIN_DEG:
        return replace(told, reason="uncertain")
    return replace(
        told,
        state="resolved",
        rotation=best.rotation,
        rotation_vector_deg=np.rad2deg(_vector_of(best.rotation)),
        standard_errors_deg=np.rad2deg(errors[:3]),
        bias_deg_s=np.rad2deg(best.bias),
        bias_errors_deg_s=np.rad2deg(errors[3:]),
        rms_deg=float(np.rad2deg(np.sqrt(best.cost))),
    )


def _window_s(covered_s: float, speed_rad_s: float, session: GyroSession) -> float:
    step_s = float(np.median(np.diff(session.t_s)))
    slow_s = min(np.deg2rad(TURN_DEG) / max(speed_rad_s, 1e-9), SLOW_WINDOW_S)
    return float(max(min(covered_s / 8.0, WINDOW_S), slow_s, (_FEWEST - 1) * step_s))


def _stretches(t_s: Floats) -> list[tuple[int, int]]:
    steps = np.diff(t_s)
    breaks = np.flatnonzero(steps > _BREAK * float(np.median(steps))) + 1
    edges = [0, *breaks.tolist(), len(t_s)]
    return [(i, j) for i, j in pairwise(edges) if j - i > 1]


def _windows(  # noqa: PLR0917
    session: GyroSession, stretches: Sequence[tuple[int, int]], window_s: float, sign: float, fewest: int, most: int
) -> _Windows:
    """Return at most ``most`` windows, evenly over the session, each of ``fewest`` samples and more."""
    pieces = []
    for i, j in stretches:
        t = session.t_s[i:j] - session.t_s[i]
        count = max(round(float(t[-1]) / window_s), 1)
        number = np.minimum((t / max(float(t[-1]), 1e-9) * count).astype(np.intp), count - 1)
        edges = np.searchsorted(number, np.arange(count + 1))
        pieces += [(i + a, i + b) for a, b in pairwise(edges) if b - a >= fewest]
    pieces = [one for one in pieces if np.count_nonzero(session.weights[one[0] : one[1]] > 0) >= fewest // 2]
    if len(pieces) > most:
        pieces = [pieces[k] for k in np.linspace(0, len(pieces) - 1, most).round().astype(int)]
    rows = np.concatenate([np.arange(a, b) for a, b in pieces]) if pieces else np.zeros(0, dtype=np.intp)
    lengths = np.array([b - a for a, b in pieces], dtype=np.intp)
    firsts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.intp) if pieces else np.zeros(0, dtype=np.intp)
    part = GyroSession(
        session.t_s[rows], session.x_nt[rows], session.b_nt[rows], session.rate_rad_s[rows], session.weights[rows]
    )
    return _Windows(part, firsts, sign)


def _best(session: GyroSession, stretches: Sequence[tuple[int, int]], window_s: float, sign: float) -> list[_State]:
    """Return the distinct minima at full length, the least first: from 24 turns of the cube, windows doubling."""
    step_s = float(np.median(np.diff(session.t_s)))
    length_s = min(max(_START_S, (_FEWEST_AT_START - 0.5) * step_s), window_s)
    windows = _windows(session, stretches, length_s, sign, _FEWEST_AT_START, _START_WINDOWS)
    if not len(windows.firsts):
        return []
    starts = [_State(turn, np.zeros(3), windows.cost(turn, np.zeros(3))) for turn in cube_turns()]
    starts.sort(key=lambda one: one.cost)
    states = _distinct([windows.refined(one, length_s, 2 * _ROUNDS_ON_THE_WAY) for one in starts[:6]])[:3]
    while length_s < window_s:
        length_s = min(2.0 * length_s, window_s)
        windows = _windows(session, stretches, length_s, sign, _FEWEST, _MOST_WINDOWS)
        if not len(windows.firsts):
            return []
        rounds = _ROUNDS if length_s >= window_s else _ROUNDS_ON_THE_WAY
        states = _distinct([windows.refined(one, length_s, rounds) for one in states])
    return states


def _long_cost(
    session: GyroSession, stretches: Sequence[tuple[int, int]], covered_s: float, start: _State, sign: float
) -> float:
    """Return the cost of one handedness on long windows: there the inertial field leaves its plane."""
    length_s = min(HAND_WINDOW_S, covered_s)
    windows = _windows(session, stretches, length_s, sign, _FEWEST, _MOST_WINDOWS)
    return windows.refined(start, length_s).cost if len(windows.firsts) else np.inf


def _distinct(states: list[_State]) -> list[_State]:
    """Return the states that are no neighbours of a better one, the least first."""
    found: list[_State] = []
    for one in sorted(states, key=lambda state: state.cost):
        if all(_apart_deg(one, other) > 1.0 for other in found):
            found.append(one)
    return found


def _apart_deg(one: _State, other: _State) -> float:
    cosine = (np.trace(one.rotation @ other.rotation.T) - 1.0) / 2.0
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _vector_of(rotation: Floats) -> Floats:
    angle = float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))
    if angle < 1e-9:
        return np.zeros(3)
    if np.pi - angle < 1e-6:
        axis = np.linalg.eigh(rotation + rotation.T)[1][:, 2]
        return np.asarray(angle * axis)
    odd = np.array([rotation[1, 2] - rotation[2, 1], rotation[2, 0] - rotation[0, 2], rotation[0, 1] - rotation[1, 0]])
    return np.asarray(odd * angle / (2.0 * np.sin(angle)))


def cube_turns() -> list[Floats]:
    """Return the 24 proper turns of a cube."""
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if np.linalg.det(turn) > 0:
                turns.append(turn)
    return turns


def _errors(windows: _Windows, state: _State, window_s: float) -> Floats:
    """Return standard errors of the turn, rad, and of the bias, rad/s, shape (6,): 1.96 of them hold 95 %.

    Notes
    -----
    Windows are left out one by one, shift = (N - N_w)^-1 g_w, covariance (W - 1) / W times their sum of squares, never
    below the formal one, with Student's t of W - 1 contained.
    """
    r, j = windows.derivatives(state.rotation, np.concatenate([np.zeros(3), state.bias]), window_s)
    edges = [*windows.firsts.tolist(), len(r)]
    parts = [slice(a, b) for a, b in pairwise(edges)]
    normals = np.stack([np.einsum("pni,qni->pq", j[:, part], j[:, part]) for part in parts])
    gradients = np.stack([np.einsum("pni,ni->p", j[:, part], r[part]) for part in parts])
    total, count = normals.sum(axis=0), len(parts)
    scaled, size = unit_diagonal(total)
    free = max(2 * int(np.count_nonzero(windows.session.weights > 0)) - 6 - 3 * count, 1)
    formal = np.linalg.pinv(scaled) / np.outer(size, size) * float(np.sum(r**2)) / free
    shifts = []
    for normal, gradient in zip(normals, gradients, strict=True):
        rest = (total - normal) / np.outer(size, size)
        shifts.append(np.linalg.pinv(rest) @ (gradient / size) / size)
    spread = np.stack(shifts)
    honest = (count - 1) / count * np.sum(spread**2, axis=0)
    return np.asarray(np.sqrt(np.maximum(honest, np.diag(formal))) * student_95(count - 1) / 1.96)

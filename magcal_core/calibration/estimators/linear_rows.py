"""A fit linearised about its estimate: rows y = J d + F a + noise, and their moments by blocks of time.

Notes
-----
An error d of the parameters and a change a(t) of the bias move the reading by dh = dT x + db + a(t), x the field in the
sensor's base frame. The scalar residual |x| - |B| moves by g^T dh with g = T^-T u, u = x / |x|; the vector residual h -
T B - b by dh itself, axis by axis. So everything is a column of time times a *carrier*: g, or 1 on the axis of the row.
All rows stand over the standard deviation of the residual, and times the root of the weights of the fit.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations, corrected_nt
from magcal_core.sensor.correction import correct, readings_without
from magcal_core.sensor.model import inverse_lower, lower_triangular_gauge
from magcal_core.sensor.parameterisation import Standardised, parameters_from_rows, rows_jacobian
from magcal_core.sensor.parameters import Parameters
from magcal_core.sensor.regressors import is_of_scale

_CHUNK: Final = 4096
"""Rows whose design is made at a time: it stays in the cache."""
_LEAST_SIGMA: Final = 1e-9
"""Smallest residual that is believed, as a share of the field: below is rounding."""
_LOWER: Final = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_FULL: Final = tuple((i, j) for i in range(3) for j in range(3))


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """What the rows are linear in: elements of T, bias, regressors, clock; and the way to the reported parameters.

    Attributes
    ----------
    entries : positions (i, j) of the elements of T that are unknown.
    drifts : regressors of the bias, standardised.
    scales : names of the regressors of the scale, and their root mean square, nT.
    clocks : number of unknowns of the clock.
    """

    entries: tuple[tuple[int, int], ...]
    drifts: Standardised
    scales: tuple[tuple[str, float], ...]
    clocks: int

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.entries) + 3 + 3 * (len(self.drifts.names) + len(self.scales)) + self.clocks

    @property
    def bias(self) -> slice:
        """Where the bias is among the unknowns."""
        return slice(len(self.entries), len(self.entries) + 3)

    def to_parameters(self, matrix: Floats) -> Floats:
        """Return the derivative of `Parameters.vector` by the unknowns, shape (p, q); T full: by those of T_low."""
        first = len(self.entries)
        inner = 9 + 3 * len(self.drifts.names)
        own = np.zeros((inner + 3 * len(self.scales) + self.clocks, self.size))
        lower = rows_jacobian(_gauge(matrix), self.drifts)
        own[:inner, first : first + inner - 6] = lower[:, 6:]
        own[:inner, :first] = lower[:, :6] @ _lower_by_entries(matrix, self.entries)
        at = inner + np.arange(3 * len(self.scales))
        own[at, at + first - 6] = [1.0 / size for _, size in self.scales for _ in range(3)]
        clock = np.arange(self.clocks)
        own[len(own) - self.clocks + clock, self.size - self.clocks + clock] = 1.0
        return own


def _gauge(matrix: Floats) -> Floats:
    return matrix if not np.triu(matrix, 1).any() else lower_triangular_gauge(matrix)[0]


def _lower_by_entries(matrix: Floats, entries: Sequence[tuple[int, int]]) -> Floats:
    """Return the derivative of the six elements of T_low, T = T_low R, by the ``entries`` of T, shape (6, entries).

    These are themselves where only they are unknown.

    Notes
    -----
    dT R^T = dL + L S with S skew; with A = L^-1 dT R^T = K + S, K lower triangular: S is minus the transpose of A's
    strict upper half and that half itself, K = A - S.
    """
    if tuple(entries) == _LOWER:
        return np.eye(len(_LOWER))
    lower = _gauge(matrix)
    inverse = inverse_lower(lower)
    turn_back = np.linalg.solve(matrix, lower)  # R^T, since T R^T = L
    found = np.zeros((6, len(entries)))
    for column, (i, j) in enumerate(entries):
        change = np.outer(inverse[:, i], turn_back[j])
        upper = np.triu(change, 1)
        found[:, column] = [(lower @ (change - upper + upper.T))[at] for at in _LOWER]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One residual of every sample, over its standard deviation and times the root of its weight.

    Attributes
    ----------
    y : shape (n,)
    jacobian : shape (n, c)
        Derivatives by the unknowns ``places``, shape (c,).
    carriers : shape (n, a)
        Change of y by a bias along the ``axes`` of the size of ``sigma_nt``.
    by_field : shape (n,)
        Change of y by one nT of |B|, or of the field's part along the axis.
    sigma_nt : float
        Standard deviation of the residual, nT.
    """

    y: Floats
    jacobian: Floats
    places: NDArray[np.intp]
    carriers: Floats
    axes: tuple[int, ...]
    by_field: Floats
    sigma_nt: float

    def terms_at(self, columns: int) -> NDArray[np.intp]:
        """Return where this channel's terms stand among all: column by column, three axes each."""
        return np.array([3 * c + axis for c in range(columns) for axis in self.axes], np.intp)

    def over(self, sigma_nt: float, root: Floats) -> Channel:
        """Return the channel, of nT so far, over its standard deviation and times the ``root`` of the weights."""
        jacobian = (root / sigma_nt)[:, None] * self.jacobian
        carriers, by_field = root[:, None] * self.carriers, root / sigma_nt * self.by_field
        y = root * self.y / sigma_nt
        return replace(self, y=y, jacobian=jacobian, carriers=carriers, by_field=by_field, sigma_nt=sigma_nt)

    def part(self, rows: slice) -> Channel:
        """Return the channel of these samples alone."""
        return replace(self, y=self.y[rows], jacobian=self.jacobian[rows], carriers=self.carriers[rows])

    def left(self, columns: Floats, d: Floats, a: Floats) -> Floats:
        """Return y - J d - F a, shape (n,); ``a``, shape (columns, 3)."""
        left = self.y - self.jacobian @ d[self.places]
        if len(a):
            left -= np.einsum("ni,ni->n", columns @ a[:, list(self.axes)], self.carriers)
        return left


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """All channels of a fit, its unknowns and what is needed to move it.

    ``prior`` counts as used where positive; ``at`` is the estimate: T, and the other unknowns of `Parameters`.
    """

    channels: tuple[Channel, ...]
    unknowns: Unknowns
    matrix: Floats
    parameters: Parameters
    used: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of rows that have weight."""
        return int(np.count_nonzero(self.used)) * len(self.channels)

    @property
    def freedom(self) -> int:
        """Rows less unknowns."""
        return self.count - self.unknowns.size

    def moments(self, columns: Floats, starts: NDArray[np.intp]) -> Moments:
        """Return the moments of the rows with ``columns`` of time, shape (n, t), by blocks that begin at ``starts``."""
        q, t = self.unknowns.size, columns.shape[1]
        total = np.zeros((len(starts), q + 3 * t + 1, q + 3 * t + 1))
        for channel in self.channels:
            at = np.concatenate([channel.places, q + channel.terms_at(t), [q + 3 * t]])
            total[:, at[:, None], at] += _block_products(channel, columns, starts)
        return Moments(total, q)

    def moved(self, d: Floats) -> tuple[Floats, Parameters]:
        """Return T and the parameters where the unknowns have moved by ``d``."""
        u, at = self.unknowns, self.parameters
        matrix = self.matrix.copy()
        for value, (i, j) in zip(d, u.entries, strict=False):
            matrix[i, j] += value
        k = len(u.drifts.names)
        first = u.bias.stop
        slopes = d[first : first + 3 * k].reshape(k, 3)
        change = parameters_from_rows(_gauge(matrix), d[u.bias], slopes, u.drifts)
        regressors = {name: at.regressors[name] + change.regressors[name] for name in u.drifts.names}
        for i, (name, size) in enumerate(u.scales):
            here = first + 3 * (k + i)
            regressors[name] = at.regressors[name] + d[here : here + 3] / size
        clock = at.time_offset_s
        if u.clocks and clock is not None:
            clock += float(d[u.size - u.clocks])
        moved = Parameters(at.bias_nt + change.bias_nt, change.scale, change.nonorthogonality_deg, clock, regressors)
        return matrix, moved


def _block_products(channel: Channel, columns: Floats, starts: NDArray[np.intp]) -> Floats:
    """Return the products of (J, F, y) with themselves, summed over each block, shape (m, w, w)."""
    edges = [*starts.tolist(), len(channel.y)]
    c, axes, t = channel.jacobian.shape[1], channel.carriers.shape[1], columns.shape[1]
    width = c + axes * t + 1
    found = np.zeros((len(starts), width, width))
    for block, (first, last) in enumerate(itertools.pairwise(edges)):
        for i in range(first, last, _CHUNK):
            part = slice(i, min(i + _CHUNK, last))
            design = np.empty((part.stop - i, width))
            design[:, :c], design[:, -1] = channel.jacobian[part], channel.y[part]
            terms = columns[part, :, None] * channel.carriers[part, None, :]
            design[:, c:-1] = terms.reshape(len(design), -1)
            found[block] += design.T @ design
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Products of (J, F, y) by blocks, shape (m, w, w); the first ``known`` columns are J, the last is y."""

    blocks: Floats
    known: int

    @property
    def total(self) -> Floats:
        """The sum over all blocks, shape (w, w)."""
        return np.asarray(self.blocks.sum(axis=0))

    def merged(self, groups: NDArray[np.intp]) -> Moments:
        """Return the moments of larger blocks, each of the blocks from one of ``groups`` up to the next."""
        made = self.blocks[groups]
        for group, (first, last) in enumerate(itertools.pairwise([*groups.tolist(), len(self.blocks)])):
            if last - first > 1:
                made[group] += self.blocks[first + 1 : last].sum(axis=0)
        return replace(self, blocks=made)

    def without(self, unknown: int) -> Moments:
        """Return the moments without one of the known columns."""
        kept = np.delete(np.arange(self.blocks.shape[1]), unknown)
        return Moments(np.ascontiguousarray(self.blocks[:, kept[:, None], kept]), self.known - 1)


def rows_of(
    observations: Observations,
    fit: Fit,
    *,
    sigmas_nt: Sequence[float] | None = None,
    at: tuple[Floats, Parameters] | None = None,
    is_full: bool = False,
) -> Rows:
    """Return the rows of ``fit``, or of the same residuals with T and the parameters moved to ``at``.

    ``sigmas_nt``: standard deviation of each channel's residual, nT; from the residuals where it is not given.
    ``is_full``: with all nine elements of T unknown, for components alone.
    """
    is_vector = fit.residuals_nt.ndim == 2
    z, scales, clocks = _regressors(observations, fit)
    unknowns = Unknowns(_FULL if is_full else _LOWER, z, scales, clocks)
    matrix = _matrix(fit.parameters)
    here = (matrix, fit.parameters) if at is None else at
    make = _vector_channels if is_vector else _scalar_channels
    root, used = np.sqrt(fit.weights), fit.weights > 0
    floor = _LEAST_SIGMA * float(np.mean(observations.b_nt))
    channels = []
    for i, raw in enumerate(make(observations, fit, here, unknowns)):
        left = root * raw.y
        if is_full:
            # The fit is one of fewer elements: what these rows leave is what their own solution leaves.
            weighed = root[:, None] * raw.jacobian
            left = left - weighed @ (scaled_inverse(weighed.T @ weighed) @ (weighed.T @ left))
        # The clock stands beside the fit's own unknowns: the noise is what these leave.
        sigma = _sigma_nt(left, int(np.count_nonzero(used)) - len(raw.places) + clocks, floor)
        channels.append(raw.over(sigma if sigmas_nt is None else sigmas_nt[i], root))
    return Rows(tuple(channels), unknowns, here[0], here[1], used)


def _sigma_nt(weighed_nt: Floats, freedom: int, floor_nt: float) -> float:
    return max(float(np.sqrt(weighed_nt @ weighed_nt / max(freedom, 1))), floor_nt)


def _matrix(parameters: Parameters) -> Floats:
    return parameters.matrix


def _regressors(o: Observations, fit: Fit) -> tuple[Standardised, tuple[tuple[str, float], ...], int]:
    names = list(fit.parameters.regressors)
    drifts = [name for name in names if not is_of_scale(name)]
    z = Standardised.of(drifts, [o.regressors[name] for name in drifts], len(o))
    scales = tuple((name, float(np.sqrt(np.mean(o.regressors[name] ** 2)))) for name in names if is_of_scale(name))
    clocks = o.rate_nt_s.shape[1]
    return z, scales, clocks


def _scale_columns(o: Observations, unknowns: Unknowns) -> list[Floats]:
    return [o.regressors[name] / size for name, size in unknowns.scales]


def _scalar_channels(o: Observations, fit: Fit, here: tuple[Floats, Parameters], unknowns: Unknowns) -> list[Channel]:
    """Return |x| - |B| with its derivatives, or the geometric residual where the fit took noise into account."""
    matrix, parameters = here
    lower = inverse_lower(matrix)
    first = _corrected(o, _matrix(fit.parameters), fit.parameters)
    b_nt = np.linalg.norm(first, axis=1) - fit.residuals_nt
    x_nt = _corrected(o, matrix, parameters)
    length = np.linalg.norm(x_nt, axis=1)
    unit = x_nt / length[:, None]
    g = unit @ lower
    y = length - b_nt
    if fit.noise_nt >= 0.0:
        squares = np.einsum("ni,ni->n", g, g)
        y -= fit.noise_nt**2 * (float(np.sum(lower**2)) - squares) / (2.0 * length)
        over = 1.0 / np.sqrt(squares)
        y, carriers = y * over, g * over[:, None]
    else:
        over, carriers = np.ones(len(o)), g
    columns = [carriers[:, i] * x_nt[:, j] for i, j in unknowns.entries]
    jacobian = [np.column_stack(columns), carriers, *(carriers * z[:, None] for z in unknowns.drifts.columns.T)]
    jacobian += [carriers * term for term in _scale_columns(o, unknowns)]
    # A later clock has a smaller reference where it falls: the residual there is that much larger.
    jacobian.append(-over[:, None] * o.rate_nt_s)
    every, by_field = np.arange(unknowns.size), -over
    return [Channel(y, np.column_stack(jacobian), every, carriers, (0, 1, 2), by_field, 1.0)]


def _corrected(o: Observations, matrix: Floats, parameters: Parameters) -> Floats:
    reading = readings_without(o.regressors, o.h_nt, parameters)
    return correct(reading, parameters.bias_nt, inverse_lower(matrix))


def _vector_channels(o: Observations, fit: Fit, here: tuple[Floats, Parameters], unknowns: Unknowns) -> list[Channel]:
    """Return h - T B - b of each axis with its derivatives; T and b are those of ``here``."""
    matrix, parameters = here
    field_nt = corrected_nt(o, fit.parameters) - fit.residuals_nt
    left = readings_without(o.regressors, o.h_nt, parameters) - parameters.bias_nt - field_nt @ matrix.T
    first, k, n = unknowns.bias.stop, len(unknowns.drifts.names), len(o)
    rates = np.zeros((n, unknowns.clocks, 3)) if o.rate_base_nt_s is None else o.rate_base_nt_s
    found: list[Channel] = []
    for axis in range(3):
        entries = [at for at, (i, _) in enumerate(unknowns.entries) if i == axis]
        columns = [field_nt[:, : len(entries)], np.ones((n, 1)), unknowns.drifts.columns]
        columns += [term[:, axis : axis + 1] for term in _scale_columns(o, unknowns)]
        columns.append(-rates @ matrix[axis])
        places = [*entries, unknowns.bias.start + axis]
        places += [first + 3 * j + axis for j in range(k + len(unknowns.scales))]
        places += range(unknowns.size - unknowns.clocks, unknowns.size)
        at, ones = np.array(places, np.intp), np.ones((n, 1))
        found.append(Channel(left[:, axis], np.column_stack(columns), at, ones, (axis,), -ones[:, 0], 1.0))
    return found

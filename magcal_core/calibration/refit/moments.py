"""What is kept of a fit so that it can be made again without its samples: its equations, summed over short blocks.

Notes
-----
At the estimate, under the weights that the fit gave the samples, each block keeps J^T W J, J^T W r and r^T W r of all
unknowns that may be asked for later: the sensor's nine, the slopes of every housekeeping column, the clock's offset.
That is what a Gauss-Newton step needs for any choice of unknowns and any weight of the blocks.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.estimators.scalar_kernel import accumulate_blocks, residuals
from magcal_core.calibration.estimators.vector import axis_sums
from magcal_core.calibration.uncertainty.consider_errors import ReferenceShift
from magcal_core.calibration.uncertainty.honest_covariance import covered_s
from magcal_core.errors import MomentsError
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.numerics.regression import block_sums
from magcal_core.observations import Observations
from magcal_core.sensor.correction import readings_without
from magcal_core.sensor.parameterisation import (
    Standardised,
    parameters_from_rows,
    rows_from_theta,
    rows_jacobian,
    theta_jacobian,
    theta_of_parameters,
)
from magcal_core.sensor.parameters import Parameters

MAX_COLUMNS: Final = 6
_BLOCKS: Final = (24, 96)
"""Fewest and most blocks with a normal matrix; where the fit has more blocks, neighbours share one."""
_ENTRIES: Final = 12_000
"""Entries of all normal matrices, 50 kB, that a file is to have at most: the more unknowns, the fewer blocks."""
_FORM: Final = 1
_LOWER: Final = np.tril_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over blocks, in the fit's own unknowns q: normals (m, q, q), scores (m, q), costs (m,), nT^2, weights (m,).

    The scores are those of the residual's derivative: half the gradient of the cost.
    """

    normals: Floats
    scores: Floats
    costs: Floats
    weights: Floats

    def moved(self, step: Floats) -> BlockSums:
        """Return the sums after the unknowns have moved by ``step``, shape (q,)."""
        along = self.normals @ step
        costs = self.costs + 2.0 * self.scores @ step + along @ step
        return replace(self, scores=self.scores + along, costs=np.maximum(costs, 0.0))

    def together(self, firsts: NDArray[np.intp]) -> BlockSums:
        """Return the sums of neighbours, which begin at the blocks ``firsts``."""
        return BlockSums(
            np.add.reduceat(self.normals, firsts, axis=0),
            np.add.reduceat(self.scores, firsts, axis=0),
            np.add.reduceat(self.costs, firsts),
            np.add.reduceat(self.weights, firsts),
        )

    def weighed(self, shares: Floats) -> BlockSums:
        """Return the sums with each block counted ``shares``, shape (m,), times."""
        by_row = shares[:, None]
        return BlockSums(
            self.normals * by_row[:, :, None], self.scores * by_row, self.costs * shares, self.weights * shares
        )


@dataclass(frozen=True, slots=True, eq=False)
class FitMoments:
    """The moments of one fit.

    Attributes
    ----------
    is_vector : bool
    columns : tuple of str
        Regressors of the bias that may be asked for, ``fitted`` those that the fit has.
    mean, spread : shape (k,)
        Of the columns, in their own units.
    has_clock, is_clock_fitted : bool
        Whether the clock's offset may be asked for, and whether it was an unknown of the fit.
    clock_s : float
        Offset, s, that the reference was taken at.
    own : shape (q,)
        The fit's own unknowns there: T^-1 and c (scalar) or T and b (vector), slopes, the clock's step.
    sums : BlockSums
    scores, weights : shape (b, q), (b,)
        Scores and weights of the fit's own blocks, of which neighbours make one of ``sums``.
    softened : float
        What the loss leaves of the normal matrix: its second derivative over its weight.
    noise : float
        Formal covariance over the inverse of the softened normal matrix: the variance, nT^2, that the fit saw.
    shifts : shape (s, q)
        What errors of the reference do to the unknowns, one row a source, at one standard deviation.
    begins, ends : datetime64[ns], shape (m,)
        First and last sample of each block, UTC.
    samples, duration_s
        Count, and time that they cover, s.
    trusted : shape (2, p)
        Parameters of the calibration, with the regressors that are fitted and the clock last, and their standard
        errors: beside errors that are locked to the orbit, of which the moments know nothing. Of no columns where the
        moments say all.
    """

    is_vector: bool
    columns: tuple[str, ...]
    fitted: tuple[str, ...]
    mean: Floats
    spread: Floats
    has_clock: bool
    is_clock_fitted: bool
    clock_s: float
    own: Floats
    sums: BlockSums
    scores: Floats
    weights: Floats
    softened: float
    noise: float
    shifts: Floats
    begins: Times
    ends: Times
    samples: int
    duration_s: float
    trusted: Floats = field(default_factory=lambda: np.zeros((2, 0)))

    @property
    def firsts(self) -> NDArray[np.intp]:
        """First of the fit's own blocks in each block of ``sums``, shape (m,)."""
        return _firsts(len(self.weights), self.own.size)

    def parameters(self, own: Floats, names: Sequence[str]) -> Parameters:
        """Return the reported parameters at the unknowns ``own``, with the regressors ``names``."""
        k, z = len(self.columns), self._columns()
        if self.is_vector:
            matrix = np.zeros((3, 3))
            matrix[_LOWER] = own[:6]
            bias_nt, slopes_nt = own[6:9], own[9 : 9 + 3 * k].reshape(k, 3)
        else:
            matrix, bias_nt, slopes_nt = rows_from_theta(own, k)
        found = parameters_from_rows(matrix, bias_nt, slopes_nt, z)
        return replace(found, regressors={name: found.regressors[name] for name in names})

    def unknowns(self, names: Sequence[str], *, has_clock: bool) -> NDArray[np.intp]:
        """Return where, among all unknowns, those of a model with the regressors ``names`` stand."""
        slopes = [9 + 3 * self.columns.index(name) + i for name in names for i in range(3)]
        return np.array([*range(9), *slopes, *([self.own.size - 1] if has_clock else [])], np.intp)

    def to_parameters(self, own: Floats) -> Floats:
        """Return the derivative of the reported parameters and the clock, shape (q, q), by the unknowns at ``own``."""
        k, z = len(self.columns), self._columns()
        inner, q = 9 + 3 * k, own.size
        jacobian = np.eye(q)
        if self.is_vector:
            matrix = np.zeros((3, 3))
            matrix[_LOWER] = own[:6]
            jacobian[:inner, :inner] = rows_jacobian(matrix, z)
        else:
            matrix, _, _ = rows_from_theta(own, k)
            jacobian[:inner, :inner] = rows_jacobian(matrix, z) @ theta_jacobian(own, k)
        return jacobian

    def _columns(self) -> Standardised:
        return Standardised(self.columns, np.zeros((0, len(self.columns))), self.mean, self.spread)

    def to_bytes(self) -> bytes:
        """Return the moments as a file: numpy arrays in a zip archive, the blocks in single precision."""
        size = np.sqrt(np.maximum(np.diagonal(self.sums.normals.sum(axis=0)), 1e-300))
        upper = np.triu_indices(self.own.size)
        normals = (self.sums.normals / np.outer(size, size))[:, upper[0], upper[1]]
        head = {
            "form": _FORM,
            "is_vector": self.is_vector,
            "columns": self.columns,
            "fitted": self.fitted,
            "has_clock": self.has_clock,
            "is_clock_fitted": self.is_clock_fitted,
            "clock_s": self.clock_s,
            "softened": self.softened,
            "noise": self.noise,
            "samples": self.samples,
            "duration_s": self.duration_s,
        }
        written = io.BytesIO()
        np.savez(
            written,
            head=np.frombuffer(json.dumps(head).encode(), np.uint8),
            mean=self.mean,
            spread=self.spread,
            own=self.own,
            shifts=self.shifts,
            size=size,
            normals=normals.astype(np.float32),
            scores=(self.scores / size).astype(np.float32),
            costs=self.sums.costs,
            weights=self.weights,
            begins=self.begins.astype("datetime64[ns]").astype(np.int64),
            ends=self.ends.astype("datetime64[ns]").astype(np.int64),
            trusted=self.trusted,
        )
        return written.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> FitMoments:
        """Return the moments in a file that `to_bytes` wrote.

        Raises
        ------
        MomentsError
            The bytes are no such file, or one of a later form.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                part = {name: file[name] for name in file.files}
            head = json.loads(part["head"].tobytes())
            if head["form"] != _FORM:
                raise MomentsError(f"the moments have form {head['form']}, this program reads {_FORM}")
            return cls._read(head, part)
        except (ValueError, KeyError, TypeError, OSError, EOFError, zlib.error, zipfile.BadZipFile) as error:
            raise MomentsError(f"no moments of a fit: {error}") from error

    @classmethod
    def _read(cls, head: dict[str, object], part: dict[str, NDArray[np.float64]]) -> FitMoments:
        own, size, upper = part["own"], part["size"], np.triu_indices(part["own"].size)
        normals = np.empty((len(part["normals"]), own.size, own.size))
        normals[:, upper[0], upper[1]] = part["normals"]
        normals[:, upper[1], upper[0]] = part["normals"]
        scores, weights = part["scores"].astype(np.float64) * size, part["weights"]
        firsts = _firsts(len(weights), own.size)
        by_block = np.add.reduceat(scores, firsts, axis=0), part["costs"], np.add.reduceat(weights, firsts)
        sums = BlockSums(normals * np.outer(size, size), *by_block)
        columns, fitted = head["columns"], head["fitted"]
        if not isinstance(columns, list) or not isinstance(fitted, list):
            raise MomentsError("no moments of a fit: the names of its columns are no list")
        return cls(
            is_vector=bool(head["is_vector"]),
            columns=tuple(columns),
            fitted=tuple(fitted),
            mean=part["mean"],
            spread=part["spread"],
            has_clock=bool(head["has_clock"]),
            is_clock_fitted=bool(head["is_clock_fitted"]),
            clock_s=float(str(head["clock_s"])),
            own=own,
            sums=sums,
            scores=scores,
            weights=weights,
            softened=float(str(head["softened"])),
            noise=float(str(head["noise"])),
            shifts=part["shifts"],
            begins=part["begins"].astype("datetime64[ns]"),
            ends=part["ends"].astype("datetime64[ns]"),
            samples=int(str(head["samples"])),
            duration_s=float(str(head["duration_s"])),
            trusted=part.get("trusted", np.zeros((2, 0))),
        )


def _firsts(blocks: int, unknowns: int) -> NDArray[np.intp]:
    """Return the first of each group of neighbours among so many blocks."""
    groups = min(max(2 * _ENTRIES // (unknowns * (unknowns + 1)), _BLOCKS[0]), _BLOCKS[1])
    return np.arange(0, blocks, -(-blocks // groups))


def moments_of_fit(
    observations: Observations, fit: Fit, t_utc: Times, shifts: Sequence[ReferenceShift], *, is_clock_fitted: bool
) -> FitMoments:
    """Return the moments of ``fit``, whose method has moments, and which has no regressors of the scale.

    ``observations``: those of the fit, at its clock, with every column that may be asked for among their regressors and
    the derivative of the reference by the clock's offset, where there is one; ``t_utc``, shape (n,): their times.
    ``shifts``: what errors of the reference do.
    """
    o, at = replace(observations, weights=fit.weights), replace(fit.parameters, time_offset_s=None)
    z = Standardised.of(tuple(o.regressors), list(o.regressors.values()), len(o))
    every, is_vector = fit.blocks.starts, fit.residuals_nt.ndim == 2
    own, fine, unit = _vector_sums(o, at, z, every) if is_vector else _scalar_sums(o, at, z, every, fit.noise_nt)
    firsts = _firsts(len(every), own.size)
    starts, sums = every[firsts], fine.together(firsts)
    made = FitMoments(
        is_vector=is_vector,
        columns=z.names,
        fitted=tuple(at.regressors),
        mean=z.mean,
        spread=z.spread,
        has_clock=bool(o.rate_nt_s.shape[1]),
        is_clock_fitted=is_clock_fitted,
        clock_s=fit.parameters.time_offset_s or 0.0,
        own=own,
        sums=sums,
        scores=fine.scores,
        weights=fine.weights,
        # The bias is the same unknown in the fit's blocks and in these.
        softened=float(unit * fit.blocks.normals[:, 6, 6].sum() / sums.normals[:, 6, 6].sum()),
        noise=1.0,
        shifts=np.zeros((len(shifts), own.size)),
        begins=t_utc[starts],
        ends=t_utc[np.append(starts[1:], len(o)) - 1],
        samples=int(np.count_nonzero(o.weights > 0)),
        duration_s=covered_s(o.t_s),
    )
    # A clock that was found beside locked errors is no unknown of the fit at it.
    take = made.unknowns(made.fitted, has_clock=is_clock_fitted and bool(fit.clock.size))
    jacobian = made.to_parameters(own)[np.ix_(take, take)]
    inverse = scaled_inverse(made.softened * sums.normals.sum(axis=0)[np.ix_(take, take)])
    variances = np.einsum("ij,jk,ik->i", jacobian[:9], inverse, jacobian[:9])
    sensor = 9 + 3 * len(made.fitted)
    for row, one in zip(made.shifts, shifts, strict=True):
        row[take[:sensor]] = np.linalg.solve(jacobian[:sensor, :sensor], one.shift[:sensor])
    return replace(made, noise=float(np.mean(np.diag(fit.covariance)[:9] / variances)))


def _scalar_sums(
    o: Observations, at: Parameters, z: Standardised, starts: NDArray[np.intp], noise_nt: float
) -> tuple[Floats, BlockSums, float]:
    """Return the unknowns (T^-1, c, slopes, clock), the sums of |T^-1 (h - b)| - |B|, and their unit over the fit's."""
    m = len(starts)
    theta = np.concatenate([theta_of_parameters(at, z), np.zeros(o.rate_nt_s.shape[1])])
    normals, scores, r = np.empty((m, theta.size, theta.size)), np.empty((m, theta.size)), np.empty(len(o))
    arrays = (o.h_nt, o.b_nt, o.weights, z.columns, o.rate_nt_s, theta)
    accumulate_blocks(*arrays, 0, 1.0, noise_nt, starts, normals, scores)
    residuals(o.h_nt, o.b_nt, z.columns, o.rate_nt_s, theta, noise_nt, r)
    costs, weights = np.add.reduceat(o.weights * r**2, starts), np.add.reduceat(o.weights, starts)
    return theta, BlockSums(normals, scores, costs, weights), 1.0


def _vector_sums(
    o: Observations, at: Parameters, z: Standardised, starts: NDArray[np.intp]
) -> tuple[Floats, BlockSums, float]:
    """Return the unknowns (T, b, slopes, clock), the sums of T B + b - h, and their unit over the fit's, nT^2.

    Each axis counts by its own noise, as in the fit; here the mean of these weights is one.
    """
    matrix, b_nt = at.matrix, o.require_vector()
    k, rates = len(z.names), o.rate_base_nt_s
    m = 0 if rates is None else rates.shape[1]
    r = readings_without(o.regressors, o.h_nt, at) - at.bias_nt - b_nt @ matrix.T
    freedom = np.count_nonzero(o.weights > 0) - np.arange(2, 5) - len(at.regressors)
    shares = np.maximum(freedom, 1) / np.maximum(o.weights @ r**2, 1e-24 * float(o.weights @ o.b_nt**2))
    unit = 1.0 / float(shares.mean())
    shares *= unit
    columns = [b_nt.T, z.columns.T, *([] if rates is None else [rates.reshape(len(o), 3 * m).T])]
    moments = block_sums(np.concatenate(columns), np.ascontiguousarray(r.T), o.weights, starts)
    scores, normals = axis_sums(moments, matrix, shares, k, m)
    slopes = [np.asarray(at.regressors.get(name, np.zeros(3))) for name in z.names]
    bias_nt = at.bias_nt + sum((mean * slope for mean, slope in zip(z.mean, slopes, strict=True)), np.zeros(3))
    scaled = [slope * spread for slope, spread in zip(slopes, z.spread, strict=True)]
    own = np.concatenate([matrix[_LOWER], bias_nt, *scaled, np.zeros(m)])
    costs, weights = np.add.reduceat((r**2 @ shares) * o.weights, starts), 3.0 * np.add.reduceat(o.weights, starts)
    return own, BlockSums(normals, -scores, costs, weights), unit

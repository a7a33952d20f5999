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
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.refit.block_sums import BlockSums, scalar_sums, vector_sums
from magcal_core.calibration.refit.choice import Choice
from magcal_core.calibration.refit.locked_sums import LockedSums, locked_sums
from magcal_core.calibration.refit.reference_sums import ReferenceSums, reference_sums
from magcal_core.calibration.terms.locked import LockedTerms
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors, ReferenceShift
from magcal_core.calibration.uncertainty.honest_covariance import covered_s
from magcal_core.errors import MomentsError
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations
from magcal_core.sensor.parameterisation import (
    Standardised,
    parameters_from_rows,
    rows_from_theta,
    rows_jacobian,
    theta_jacobian,
)
from magcal_core.sensor.parameters import Parameters

MAX_COLUMNS: Final = 6
_BLOCKS: Final = (24, 96)
"""Fewest and most blocks with a normal matrix; where the fit has more blocks, neighbours share one."""
_ENTRIES: Final = 12_000
"""Entries of all normal matrices, 50 kB, that a file is to have at most: the more unknowns, the fewer blocks."""
_FORM: Final = 2
_OLD_FORM: Final = 1
"""That of moments that do not know of hidden errors."""
_LOWER: Final = np.tril_indices(3)


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
    own_begins, own_ends : datetime64[ns], shape (b,)
        The same of the fit's own blocks; in moments from before these were kept, of the block that each is of.
    samples, duration_s
        Count, and time that they cover, s.
    trusted : shape (2, p)
        Parameters of the calibration, with the regressors that are fitted and the clock last, and their standard
        errors beside errors that are locked to the orbit. Of no columns where there are none.
    locked : LockedSums, optional
        Errors locked to the orbit, where the calibration considered any.
    reference : ReferenceSums, optional
        Errors of the reference, where it came from an orbit.
    is_old : bool
        Whether the moments are from before they had these: what they tell of another model's errors may be too small.
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
    own_begins: Times
    own_ends: Times
    samples: int
    duration_s: float
    trusted: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    locked: LockedSums | None = None
    reference: ReferenceSums | None = None
    is_old: bool = False

    @property
    def firsts(self) -> NDArray[np.intp]:
        """First of the fit's own blocks in each block of ``sums``, shape (m,)."""
        return _firsts(len(self.weights), self.own.size)

    @property
    def of(self) -> NDArray[np.intp]:
        """Return the block of ``sums`` that each of the fit's own blocks is of, shape (b,)."""
        return np.repeat(np.arange(len(self.firsts)), np.diff([*self.firsts, len(self.weights)]))

    def cut(self, shares: Floats) -> BlockSums:
        """Return the sums with each of the fit's own blocks counted ``shares``, shape (b,), times.

        Normal matrices are known of whole blocks alone, and so are costs: they have the share of the weight.
        """
        weights, counted = np.add.reduceat(self.weights * shares, self.firsts), self.shares_of_sums(shares)
        scores = np.add.reduceat(self.scores * shares[:, None], self.firsts, axis=0)
        return BlockSums(self.sums.normals * counted[:, None, None], scores, self.sums.costs * counted, weights)

    def shares_of_sums(self, shares: Floats) -> Floats:
        """Return how much each block of ``sums`` counts, shape (m,), where the fit's own count ``shares``, shape (b,).

        By weight, and by number where a block has none.
        """
        alike = np.add.reduceat(shares, self.firsts) / np.bincount(self.of)
        left = np.add.reduceat(self.weights * shares, self.firsts)
        return np.divide(left, self.sums.weights, out=alike, where=self.sums.weights > 0.0)

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

    def choice(self, names: Sequence[str], shares: Floats, *, has_clock: bool) -> Choice:
        """Return the unknowns of a model with the regressors ``names``, each block counted ``shares``, shape (m,)."""
        columns = [name for name in names if name in self.columns]
        take = self.unknowns(columns, has_clock=has_clock)
        return Choice(take, self._columns(), tuple(columns), has_clock, shares, self.sums.weights)

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
        hidden: dict[str, Any] = {}
        for one in (self.locked, self.reference):
            hidden |= {} if one is None else one.parts()
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
            own_begins=self.own_begins.astype("datetime64[ns]").astype(np.int64),
            own_ends=self.own_ends.astype("datetime64[ns]").astype(np.int64),
            trusted=self.trusted,
            **hidden,
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
            if head["form"] not in {_OLD_FORM, _FORM}:
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
        of = np.repeat(np.arange(len(firsts)), np.diff([*firsts, len(weights)]))
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
            own_begins=part.get("own_begins", part["begins"][of]).astype("datetime64[ns]"),
            own_ends=part.get("own_ends", part["ends"][of]).astype("datetime64[ns]"),
            samples=int(str(head["samples"])),
            duration_s=float(str(head["duration_s"])),
            trusted=part.get("trusted", np.zeros((2, 0))),
            locked=LockedSums.of_parts(part),
            reference=ReferenceSums.of_parts(part),
            is_old=head["form"] == _OLD_FORM,
        )


def _firsts(blocks: int, unknowns: int) -> NDArray[np.intp]:
    """Return the first of each group of neighbours among so many blocks."""
    groups = min(max(2 * _ENTRIES // (unknowns * (unknowns + 1)), _BLOCKS[0]), _BLOCKS[1])
    return np.arange(0, blocks, -(-blocks // groups))


def moments_of_fit(  # noqa: PLR0917
    observations: Observations,
    fit: Fit,
    t_utc: Times,
    shifts: Sequence[ReferenceShift],
    errors: ReferenceErrors | None = None,
    terms: LockedTerms | None = None,
    *,
    is_clock_fitted: bool,
) -> FitMoments:
    """Return the moments of ``fit``, whose method has moments, and which has no regressors of the scale.

    Parameters
    ----------
    observations : Observations
        Those of the fit, at its clock, with every column that may be asked for among their regressors and the
        derivative of the reference by the clock's offset, where there is one.
    fit : Fit
    t_utc : shape (n,)
        Times of the samples.
    shifts : sequence of ReferenceShift
        What errors of the reference do.
    errors, terms : optional
        These errors themselves, and the locked errors that the calibration considered.
    is_clock_fitted : bool
        Whether the clock was an unknown.
    """
    o, at = replace(observations, weights=fit.weights), replace(fit.parameters, time_offset_s=None)
    z = Standardised.of(tuple(o.regressors), list(o.regressors.values()), len(o))
    every, is_vector = fit.blocks.starts, fit.residuals_nt.ndim == 2
    own, fine, unit = vector_sums(o, at, z, every) if is_vector else scalar_sums(o, at, z, every, fit.noise_nt)
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
        own_begins=t_utc[every],
        own_ends=t_utc[np.append(every[1:], len(o)) - 1],
        samples=int(np.count_nonzero(o.weights > 0)),
        duration_s=covered_s(o.t_s),
        locked=None
        if terms is None
        else locked_sums(
            observations, fit, terms, starts, is_clock_fitted=is_clock_fitted and bool(observations.rate_nt_s.shape[1])
        ),
        reference=None if errors is None else reference_sums(observations, fit, errors, starts),
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

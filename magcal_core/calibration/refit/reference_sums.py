"""What errors of the reference do to the unknowns of a fit, kept with its moments for refits with other unknowns."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.refit.choice import Choice, Parts, symmetric, with_slopes
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors
from magcal_core.errors import NotObservableError
from magcal_core.numerics.linear_algebra import is_positive_definite, scaled_inverse
from magcal_core.observations import Observations

LATE: Final = "orbit_along_track"
"""The error of the reference that a clock among the unknowns takes up."""
_REFERENCE_BLOCKS: Final = 24


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceSums:
    """Products of (J, C) of rows that stand for all, C what each error of the reference does to the residual.

    Attributes
    ----------
    blocks : shape (b, q + m, q + m)
    firsts : shape (b,)
        First block of the fit's sums in each of them.
    sources : tuple of str
        Names of the m errors.
    mean, spread : shape (k,)
        Of the regressors over these rows.
    matrix : shape (3, 3)
        T at the fit.
    """

    blocks: Floats
    firsts: NDArray[np.intp]
    sources: tuple[str, ...]
    mean: Floats
    spread: Floats
    matrix: Floats

    def shifts(self, choice: Choice) -> Floats:
        """Return what each error does to the parameters of ``choice``, shape (m, p).

        Raises
        ------
        NotObservableError
            What is left of these rows does not determine the unknowns.
        """
        q = self.blocks.shape[1] - len(self.sources)
        total = np.tensordot(choice.shares_of(self.firsts), self.blocks, 1)
        normal = total[np.ix_(choice.take, choice.take)]
        if not is_positive_definite(normal):
            raise NotObservableError("what is left of the data does not determine the unknowns")
        moves = total[q:, choice.take] @ scaled_inverse(normal)
        if choice.has_clock:
            moves = moves[[name != LATE for name in self.sources]]
        return np.asarray(moves @ choice.to_parameters(self.matrix, self.mean, self.spread).T)

    def parts(self) -> dict[str, NDArray[np.generic]]:
        """Return the arrays that a file keeps."""
        width = self.blocks.shape[1]
        size = np.sqrt(np.maximum(np.diag(self.blocks.sum(axis=0)), 1e-300))
        upper = np.triu_indices(width)
        return {
            "reference_blocks": (self.blocks / np.outer(size, size))[:, upper[0], upper[1]].astype(np.float32),
            "reference_size": size,
            "reference_firsts": self.firsts.astype(np.int32),
            "reference_standard": np.stack([self.mean, self.spread]),
            "reference_matrix": self.matrix,
            "reference_sources": np.frombuffer(",".join(self.sources).encode(), np.uint8),
        }

    @classmethod
    def of_parts(cls, part: Parts) -> ReferenceSums | None:
        """Return the sums of a file; None where it has none."""
        if "reference_size" not in part:
            return None
        size = part["reference_size"]
        blocks = symmetric(part["reference_blocks"].astype(np.float64), len(size)) * np.outer(size, size)
        mean, spread = part["reference_standard"]
        sources = tuple(part["reference_sources"].tobytes().decode().split(","))
        return cls(blocks, part["reference_firsts"].astype(np.intp), sources, mean, spread, part["reference_matrix"])


def reference_sums(o: Observations, fit: Fit, errors: ReferenceErrors, starts: NDArray[np.intp]) -> ReferenceSums:
    """Return what ``errors`` do about ``fit``; ``o`` and ``starts`` as in `locked_sums`."""
    wide = replace(fit, parameters=with_slopes(replace(fit.parameters, time_offset_s=None), o))
    linear, products = errors.products(o, wide, starts)
    firsts = np.arange(0, len(starts), -(-len(starts) // _REFERENCE_BLOCKS))
    drifts = linear.unknowns.drifts
    made = np.add.reduceat(products, firsts, axis=0)
    names = tuple(name for name, _ in errors.named)
    return ReferenceSums(made, firsts, names, drifts.mean, drifts.spread, linear.matrix)

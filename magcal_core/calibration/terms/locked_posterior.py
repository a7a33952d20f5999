"""Posterior of a fit's unknowns beside locked errors, from moments alone: no sample is looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.linear_rows import Moments
from magcal_core.calibration.terms.evidence import SIZES, Mixture, Reduced, mixture_of, require_positive_definite
from magcal_core.calibration.uncertainty.honest_covariance import student_95
from magcal_core.calibration.uncertainty.low_frequencies import low_frequency_variances
from magcal_core.numerics.blocks import BlockScores

DRIFT: Final = "drift"
"""The family of a line in time."""
DRIFT_SIZES: Final = (0.0, 1.0)
"""Its sizes, in standard deviations of the residual, which is mostly the drift where there is one."""
COHERENCE: Final = 0.1
"""Root mean square coherence of the unseen part of the sun's term with what parameters do: 0.03 to 0.15 measured."""


@dataclass(frozen=True, slots=True, eq=False)
class LockedFamilies:
    """Which family each term is of.

    Attributes
    ----------
    names : tuple of str
        Families that there are.
    of_terms : shape (f,)
        Family, from 0, of every column of time times axis.
    unseen : float
        Mean square of the sun across the field over that along it; 0 where attitude is known.
    """

    names: tuple[str, ...]
    of_terms: NDArray[np.intp]
    unseen: float = 0.0

    @property
    def own_sizes(self) -> Mapping[int, tuple[float, ...]]:
        """Sizes of the families that have others than the rest, by their numbers."""
        return {self.names.index(DRIFT): DRIFT_SIZES} if DRIFT in self.names else {}


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """What moments about an estimate say of everything that their rows are linear in.

    Attributes
    ----------
    moments : Moments
        Products of (J, F, y) by blocks.
    reduced : Reduced
        Their sum with the unknowns eliminated.
    mixture : Mixture
        Posterior over the sizes of the families.
    families : LockedFamilies
    share : float
        Effective share of the rows (k).
    count : int
        Rows that have weight.
    """

    moments: Moments
    reduced: Reduced
    mixture: Mixture
    families: LockedFamilies
    share: float
    count: int

    @classmethod
    def of(  # noqa: PLR0917
        cls,
        moments: Moments,
        reduced: Reduced,
        families: LockedFamilies,
        share: float,
        count: int,
        sizes: tuple[float, ...] = SIZES,
    ) -> Posterior:
        """Return the posterior of ``moments``, whose sum is ``reduced``, over ``sizes`` of every family."""
        freedom = count - moments.known
        mixture = mixture_of(reduced, families.of_terms, freedom, share, sizes, families.own_sizes)
        return cls(moments, reduced, mixture, families, share, count)

    @property
    def likeliest(self) -> Floats:
        """Size of every term in the likeliest combination, shape (f,)."""
        return np.asarray(self.mixture.sizes[0][self.families.of_terms])

    def widening(  # noqa: PLR0917
        self,
        own: Floats,
        posterior: Floats,
        blocks: NDArray[np.intp],
        softening: float,
        duration_s: float,
        least: Floats | None = None,
    ) -> Floats:
        """Return honest over posterior standard errors, at least 1, from the scores of the likeliest combination.

        Parameters
        ----------
        own : shape (p, q)
            Derivative of what is asked for by the unknowns.
        posterior : shape (p,)
            Its posterior variances.
        blocks : shape (b,)
            First blocks of the moments that make one of the scores each.
        softening : float
            What a robust loss divides the normal matrix by.
        duration_s : float
            Time that the samples cover, s.
        least : shape (p,), optional
            Variances below which none is believed where no family is likely.
        """
        roots = self.likeliest
        used = np.flatnonzero(roots > 0)
        known, b = self.moments.known, len(blocks)
        every = np.concatenate([np.arange(known), known + used, [self.moments.blocks.shape[1] - 1]])
        few = Moments(np.ascontiguousarray(self.moments.blocks[:, every[:, None], every]), known)
        merged, take = few.merged(blocks).blocks, np.arange(known + len(used))
        normals = merged[:, :-1, :-1]
        prior = np.concatenate([np.zeros(known), 1.0 / (self.share * roots[used] ** 2)])
        found = np.linalg.solve(normals.sum(axis=0) + np.diag(prior), merged.sum(axis=0)[take, -1])
        scores = merged[:, take, -1] - normals @ found - prior * found / b
        softened = normals / softening + np.diag(prior) / b
        require_positive_definite(softened.sum(axis=0))
        to_parameters = np.zeros((len(own), len(take)))
        to_parameters[:, :known] = own
        made = BlockScores(scores, softened, blocks, to_parameters)
        variances, frequencies = low_frequency_variances(made, duration_s)
        honest = variances * (student_95(frequencies) / 1.96) ** 2
        formal = np.diag(own @ self.mixture.covariances[0] @ own.T)
        raised = np.maximum(honest / np.maximum(formal, 1e-300), 1.0)
        if not len(used) and least is not None:
            raised = np.maximum(raised, least / np.maximum(posterior, 1e-300))
        return np.asarray(np.sqrt(raised))

    def unseen_sun(self) -> tuple[float, Floats]:
        """Return what a term of the sun may have across the field and what it adds to the covariance, shape (q, q).

        The former in standard deviations of the residual; 0 where none is seen or attitude is known.
        """
        q = self.moments.known
        nothing = np.zeros((q, q))
        names, unseen = self.families.names, self.families.unseen
        if "sun" not in names or unseen <= 0.0:
            return 0.0, nothing
        at = np.flatnonzero(self.families.of_terms == names.index("sun"))
        a, n = self.mixture.term[at], self.count
        squares = self.moments.total[q + at[:, None], q + at]
        seen = float(a @ squares @ a) / n - 2.0 * len(at) / n
        if seen <= 0.0:
            return 0.0, nothing
        return float(np.sqrt(seen * unseen)), COHERENCE**2 * n * unseen * seen * self.reduced.inverse

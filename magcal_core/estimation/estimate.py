"""What the steps of an estimate hand to one another."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.estimators.contract import Estimator, Fit, FitSettings
from magcal_core.calibration.estimators.loss import LossFit, LossUse
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.scale_terms import WithScaleTerms
from magcal_core.calibration.terms.clock import ClockFit
from magcal_core.calibration.terms.coarse_clock import CoarseClock
from magcal_core.calibration.terms.full_matrix import FullMatrix
from magcal_core.calibration.terms.locked import LockedTerms
from magcal_core.calibration.terms.locked_clock import LockedClock
from magcal_core.calibration.terms.odd_light import OddLight
from magcal_core.calibration.terms.regressor_candidates import RegressorCandidate, expanded
from magcal_core.calibration.terms.regressor_selection import Ablation
from magcal_core.calibration.uncertainty.consider_errors import ReferenceShift
from magcal_core.calibration.uncertainty.honest_covariance import HonestCovariance
from magcal_core.errors import OptionError
from magcal_core.estimation.session import LockedSession
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced

if TYPE_CHECKING:
    from magcal_core.calibration.terms.trimmed_clock import TrimmedClock


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Samples with their reference as the method sees them, and how to fit them.

    ``usable``: which samples the method can use, shape (n,); ``names``: regressors that were asked for by name;
    ``session``: what the errors of their bias may be locked to; ``kept``: samples that may be used at all, shape (n,),
    where some were left out after a first fit.
    """

    referenced: Referenced
    options: CalibrationOptions
    estimator: Estimator
    settings: FitSettings
    names: tuple[str, ...]
    usable: NDArray[np.bool_]
    observations: Observations
    session: LockedSession
    kept: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, referenced: Referenced, options: CalibrationOptions) -> Prepared:
        """Return what ``options`` make of the samples.

        Raises
        ------
        InputError
            An option does not suit the method, or the samples cannot be used.
        """
        estimator: Estimator = WithScaleTerms(ESTIMATORS[options.method])
        keeping = tuple(referenced.samples.housekeeping)
        names = () if isinstance(options.regressors, str) else expanded(options.regressors, keeping)
        if names and not estimator.takes_regressors:
            raise OptionError(f"{estimator.name} takes no regressors; scalar and vector do")
        noise_model = "none" if options.noise_model == "auto" else options.noise_model
        settings = FitSettings(options.robust, noise_model, options.noise_nt)
        usable = referenced.usable(names, estimator.is_vector)
        session = LockedSession(referenced, usable, estimator.is_vector)
        observed = referenced.observations(usable, names)
        return cls(referenced, options, estimator, settings, names, usable, observed, session)

    def with_names(self, names: tuple[str, ...]) -> Prepared:
        """Return the same with other regressors, and with the samples that have them."""
        usable = self.referenced.usable(names, self.estimator.is_vector)
        return self._of(names, usable if self.kept is None else usable & self.kept)

    def without(self, rows: NDArray[np.bool_]) -> Prepared:
        """Return the same without ``rows`` of its observations, shape (len(observations),)."""
        kept = np.ones(len(self.usable), dtype=bool) if self.kept is None else self.kept.copy()
        kept[np.flatnonzero(self.usable)[rows]] = False
        return replace(self._of(self.names, self.usable & kept), kept=kept)

    def _of(self, names: tuple[str, ...], usable: NDArray[np.bool_]) -> Prepared:
        observations = self.referenced.observations(usable, names)
        session = LockedSession(self.referenced, usable, self.estimator.is_vector)
        return replace(self, names=names, usable=usable, observations=observations, session=session)


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """What is known beside a fit.

    Attributes
    ----------
    plain : Fit
        The fit before locked errors moved it.
    terms : LockedTerms, optional
        The locked errors, where there is anything that they are locked to.
    honest : HonestCovariance, optional
        Its covariance beside them, errors of the reference left out; None where the fit's own scores tell it.
    shifts : tuple of ReferenceShift
        What errors of the reference do to the parameters.
    full : FullMatrix, optional
        All nine elements of T, where they are the result.
    """

    plain: Fit
    terms: LockedTerms | None
    honest: HonestCovariance | None
    shifts: tuple[ReferenceShift, ...]
    full: FullMatrix | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The fit and what it was made of.

    Attributes
    ----------
    prepared : Prepared
        The samples and the options; ``observations`` are those of the fit, at the clock that it was made at.
    loss : LossFit
        The loss and where it began.
    coarse : TrimmedClock, optional
        The scan of the clock, where one was made.
    clock, tried_clock : ClockFit or LockedClock, optional
        The clock where its offset is part of the result, and the one that was looked for.
    ablation, candidates
        Models that were tried, and columns that might have been regressors.
    far_clock : CoarseClock, optional
        A clock that is minutes or hours off, where one was looked for.
    trust : Trust, optional
        What stands beside the fit once locked errors have been weighed.
    odd_light : OddLight, optional
        Rows in the sun, or in shadow, that were left out.
    """

    prepared: Prepared
    observations: Observations
    fit: Fit
    loss: LossFit
    coarse: TrimmedClock | None = None
    clock: ClockFit | LockedClock | None = None
    tried_clock: ClockFit | LockedClock | None = None
    far_clock: CoarseClock | None = None
    trust: Trust | None = None
    ablation: tuple[Ablation, ...] = field(default=())
    candidates: tuple[RegressorCandidate, ...] = field(default=())
    odd_light: OddLight | None = None

    @property
    def estimator(self) -> Estimator:
        """The method."""
        return self.prepared.estimator

    @property
    def options(self) -> CalibrationOptions:
        """The options of the calibration."""
        return self.prepared.options

    @property
    def settings(self) -> FitSettings:
        """The settings of the fit: with the loss that is used, and where it begins."""
        return self.loss.settings

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which samples the fit was given, shape (n,)."""
        return self.prepared.usable

    @property
    def loss_use(self) -> LossUse:
        """What the record says of the loss."""
        return self.loss.use(self.options.robust, self.fit, self.observations)


def still(observations: Observations) -> Observations:
    """Return the observations with their clock fixed where it is."""
    return replace(observations, rate_nt_s=np.zeros((0, 0)), rate_base_nt_s=None)

"""A session that is not calibrated by itself, with what may be hidden in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magcal_core.calibration.estimators.contract import Fit
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors
from magcal_core.estimation.session import LockedSession
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.reference.referenced_samples import Referenced


@dataclass(frozen=True, slots=True, eq=False)
class SurroundedSession:
    """A session with what may be hidden in it: locked errors where they ``are_asked``, and those of its reference."""

    session: LockedSession
    are_asked: bool
    is_clock_known: bool

    @classmethod
    def of(
        cls,
        referenced: Referenced,
        usable: NDArray[np.bool_],
        options: CalibrationOptions,
        is_vector: bool,
        *,
        is_clock_known: bool,
    ) -> SurroundedSession:
        """Return the ``usable`` samples of a session under ``options``."""
        session = LockedSession(referenced, usable, is_vector)
        return cls(session, options.locked_terms == "auto", is_clock_known)

    def columns(self, observations: Observations, fit: Fit) -> LockedColumns | None:
        """Return the locked columns, where they are asked for and there are any."""
        return self.session.columns(observations, fit) if self.are_asked else None

    def reference(self) -> ReferenceErrors | None:
        """Return the errors of the reference; that of the orbit along its track where no clock is known."""
        return self.session.errors(0.0 if self.is_clock_known else None)

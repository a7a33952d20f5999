"""What a refit is asked for, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from magcal_core.calibration.terms.clock import ClockTest
from magcal_core.calibration.terms.regressor_selection import Ablation
from magcal_core.calibration.uncertainty.bootstrap import Bootstrap
from magcal_core.sensor.parameters import Parameters
from magcal_core.telemetry.spans import Span


@dataclass(frozen=True, slots=True)
class RefitOptions:
    """What is to be different.

    Attributes
    ----------
    regressors : tuple of str, or ``auto``, optional
        Columns that move the bias; ``auto``: those that unseen blocks support. Those of the fit unless given.
    time_offset : bool, optional
        Whether the clock's offset is an unknown. As in the fit unless given.
    without : tuple of (begin, end)
        Spans of time, UTC, to leave out: to within a block, of which there are 96 at most, 24 with many columns.
    bootstrap, seed : int
        Replicates, none unless given, and the seed that they are drawn with.
    """

    regressors: tuple[str, ...] | Literal["auto"] | None = None
    time_offset: bool | None = None
    without: tuple[Span, ...] = ()
    bootstrap: int = 0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """One parameter before and after, with its honest standard error after."""

    parameter: str
    before: float
    after: float
    standard_error: float

    def to_dict(self) -> dict[str, object]:
        """Return the change as the records have it."""
        return {
            "parameter": self.parameter,
            "before": self.before,
            "after": self.after,
            "standard_error": self.standard_error,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """A refit from moments.

    Attributes
    ----------
    rms_nt, cross_validated_rms_nt : float
        Weighted by the fit's weights; on unseen blocks None where the rest does not determine the unknowns.
    left_out_share : float
        Share of the weight that the spans took.
    ablation : tuple of Ablation
        Models that were tried, the chosen one among them.
    warnings : tuple of str
        What the errors do not contain, where they do not contain all.
    """

    parameters: Parameters
    standard_errors: Parameters
    changes: tuple[ParameterChange, ...]
    rms_nt: float
    cross_validated_rms_nt: float | None
    samples: int
    blocks: int
    left_out_share: float
    ablation: tuple[Ablation, ...]
    time_offset: ClockTest | None
    bootstrap: Bootstrap | None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return the refit as the service answers it."""
        return {
            "parameters": self.parameters.to_dict(),
            "standard_errors": self.standard_errors.to_dict(),
            "changes": [change.to_dict() for change in self.changes],
            "rms_nt": self.rms_nt,
            "cross_validated_rms_nt": self.cross_validated_rms_nt,
            "samples": self.samples,
            "blocks": self.blocks,
            "left_out_share": self.left_out_share,
            "ablation": [row.to_dict() for row in self.ablation],
            "time_offset": None if self.time_offset is None else self.time_offset.to_dict(),
            "bootstrap": None if self.bootstrap is None else self.bootstrap.to_dict(),
            "warnings": list(self.warnings),
        }

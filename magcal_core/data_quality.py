"""What the rows of a session are worth to a fit: how many there are, which are left out and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.samples import EXCLUDED, SampleFlag, Samples

WITHOUT_READING: Final = (
    SampleFlag.NOT_FINITE
    | SampleFlag.ZERO
    | SampleFlag.FILL_VALUE
    | SampleFlag.STUCK
    | SampleFlag.REPEATED
    | SampleFlag.SATURATED
)
WORTH_A_WARNING: Final = 0.01
"""Share of rows without a reading that is worth a warning."""


@dataclass(frozen=True, slots=True)
class DataQuality:
    """The rows of a session.

    Attributes
    ----------
    rows : all of them, ``used``: those that have weight in the fit.
    flagged : flag -> rows that bear it and are therefore in no fit.
    rejected, rejected_share : rows that the loss rejected, and their share of those that the fit was given.
    without_reading : rows that the screen, or their emptiness, keeps out.
    """

    rows: int
    used: int
    flagged: Mapping[str, int]
    rejected: int
    rejected_share: float
    without_reading: int

    @classmethod
    def of(cls, samples: Samples, weights: Floats | None = None) -> DataQuality:
        """Return the quality of ``samples``; ``weights``: of those that a fit was given, where one was made."""
        flagged = {}
        for flag in SampleFlag:
            count = int(np.count_nonzero(samples.flags & np.uint16(flag))) if flag & EXCLUDED and flag.name else 0
            if count and flag.name:
                flagged[flag.name.lower()] = count
        given = int(np.count_nonzero(samples.is_used)) if weights is None else len(weights)
        rejected = 0 if weights is None else int(np.count_nonzero(~(weights > 0)))
        bad = int(np.count_nonzero(samples.flags & np.uint16(WITHOUT_READING)))
        return cls(len(samples), given - rejected, flagged, rejected, rejected / max(given, 1), bad)

    @property
    def without_reading_share(self) -> float:
        """Share of the rows that hold no reading."""
        return self.without_reading / max(self.rows, 1)

    @property
    def warnings(self) -> Iterator[str]:
        """Say which rows hold no reading, where they are many, and that the sensor was at its limits."""
        kinds = [name for name, count in self.flagged.items() if SampleFlag[name.upper()] & WITHOUT_READING and count]
        if self.without_reading_share >= WORTH_A_WARNING:
            counts = ", ".join(f"{self.flagged[name]} {name}" for name in kinds)
            yield (
                f"rows_without_reading: {self.without_reading} of {self.rows} rows "
                f"({self.without_reading_share:.1%}) hold no reading and are left out: {counts}"
            )
        if "saturated" in self.flagged:
            yield (
                f"saturated: {self.flagged['saturated']} rows stand at a limit of the sensor and are left out; what it "
                "reads near its limits may be bent as well"
            )

    def to_dict(self) -> dict[str, object]:
        """Return the quality as the records have it."""
        return {
            "rows": self.rows,
            "used": self.used,
            "flagged": dict(self.flagged),
            "rejected": self.rejected,
            "rejected_share": self.rejected_share,
        }

"""What the rows of a session are worth to a fit: how many there are, which are left out and why."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Mask, Times
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
MOST_STRETCHES: Final = 3
_FEWEST: Final = 20
"""Rows that a stretch has rejected more than kept, at least."""
_BY_CHANCE: Final = 3.0
"""Times the longest lead that as many rows would have by chance, were they rejected one by one."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows next to each other most of which the loss rejects: from a time on, until before another, UTC."""

    begin: np.datetime64
    end: np.datetime64
    samples: int
    rejected: int

    def to_dict(self) -> dict[str, object]:
        """Return the stretch as the records have it."""
        begin, end = (f"{np.datetime_as_string(one, unit='us')}Z" for one in (self.begin, self.end))
        return {"from": begin, "until": end, "samples": self.samples, "rejected": self.rejected}


def rejected_stretches(t_utc: Times, is_rejected: Mask) -> tuple[Stretch, ...]:
    """Return the stretches of time, the longest first, in which most rows are rejected; none of rows here and there.

    Parameters
    ----------
    t_utc, is_rejected : shape (n,)
        In time order.

    Notes
    -----
    A stretch is where rejected rows outnumber the others by most: the largest sum of +1 and -1 over consecutive rows.
    Rows that are rejected one by one with probability p < 1/2 lead by about ln n / ln((1 - p) / p) somewhere [KARLIN]:
    a stretch leads by three times as much.
    """
    n, share = len(is_rejected), float(np.mean(is_rejected)) if len(is_rejected) else 0.0
    if not 0.0 < share < 0.5:
        return ()
    least = max(float(_FEWEST), _BY_CHANCE * math.log(n) / math.log((1.0 - share) / share))
    scores = np.where(is_rejected, 1, -1)
    found = []
    for _ in range(MOST_STRETCHES):
        sums = np.concatenate([[0], np.cumsum(scores)])
        lead = sums - np.minimum.accumulate(sums)
        end = int(np.argmax(lead))
        if lead[end] < least:
            break
        begin = end - 1 - int(np.argmin(sums[:end][::-1]))
        step = np.median(np.diff(t_utc[begin:end]).astype(np.int64)).astype("timedelta64[ns]")
        rejected = int(np.count_nonzero(is_rejected[begin:end]))
        found.append(Stretch(t_utc[begin], t_utc[end - 1] + step, end - begin, rejected))
        scores[begin:end] = -n
    return tuple(found)


@dataclass(frozen=True, slots=True)
class DataQuality:
    """The rows of a session.

    Attributes
    ----------
    rows : all of them, ``used``: those that have weight in the fit.
    flagged : flag -> rows that bear it and are therefore in no fit.
    rejected, rejected_share : rows that the loss rejected, and their share of those that the fit was given.
    without_reading : rows that the screen, or their emptiness, keeps out.
    stretches : where the loss rejects most rows.
    """

    rows: int
    used: int
    flagged: Mapping[str, int]
    rejected: int
    rejected_share: float
    without_reading: int
    stretches: Sequence[Stretch] = ()

    @classmethod
    def of(cls, samples: Samples, weights: Floats | None = None, t_utc: Times | None = None) -> DataQuality:
        """Return the quality of ``samples``; ``weights`` and ``t_utc``: of those that a fit was given."""
        flagged = {}
        for flag in SampleFlag:
            count = int(np.count_nonzero(samples.flags & np.uint16(flag))) if flag & EXCLUDED and flag.name else 0
            if count and flag.name:
                flagged[flag.name.lower()] = count
        given = int(np.count_nonzero(samples.is_used)) if weights is None else len(weights)
        rejected = 0 if weights is None else int(np.count_nonzero(~(weights > 0)))
        bad = int(np.count_nonzero(samples.flags & np.uint16(WITHOUT_READING)))
        stretches = () if weights is None or t_utc is None else rejected_stretches(t_utc, ~(weights > 0))
        return cls(len(samples), given - rejected, flagged, rejected, rejected / max(given, 1), bad, stretches)

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
            "rejected_stretches": [one.to_dict() for one in self.stretches],
        }

"""An index of the external field as a file gives it: intervals with their values, and where they come from."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds

HOUR_NS: Final = 3_600_000_000_000
INDEX_NAMES: Final = ("RC", "Dst", "Kp")
"""Ring current index with or without its parts [RC]_, disturbance storm time [DST]_, planetary index [KP]_."""


@dataclass(frozen=True, slots=True, eq=False)
class Index:
    """The index in one file: means over intervals, in the order of time.

    Attributes
    ----------
    name : str
        One of `INDEX_NAMES`.
    format : str
        Format of the file, as `magcal_core.field.index_files.READERS` names it.
    start_ns : int64, shape (n,)
        Start of each interval, nanoseconds since 1970, UTC.
    step_ns : int
        Length of an interval, nanoseconds: an hour; three hours, an hour or half an hour of Kp.
    value : shape (n,)
        RC or Dst, nT, or Kp; NaN where the file has an interval without a value.
    external_nt, induced_nt : shape (n,)
        The two parts of RC, nT; NaN where the file does not have them.
    sha256 : str
        Digest of the file.
    """

    name: str
    format: str
    start_ns: Nanoseconds
    step_ns: int
    value: Floats
    external_nt: Floats
    induced_nt: Floats
    sha256: str

    @property
    def rows(self) -> int:
        """Intervals that the file has."""
        return len(self.start_ns)

    @property
    def missing(self) -> int:
        """Intervals among them without a value."""
        return int(np.count_nonzero(np.isnan(self.value)))

    @property
    def first_utc(self) -> np.datetime64:
        """Start of the first interval, UTC."""
        return np.datetime64(int(self.start_ns[0]), "ns")

    @property
    def last_utc(self) -> np.datetime64:
        """End of the last interval, UTC."""
        return np.datetime64(int(self.start_ns[-1]) + self.step_ns, "ns")

    def between(self, first_ns: int, last_ns: int) -> Index:
        """Return the intervals that touch the time from ``first_ns`` to ``last_ns``; at least one of them is kept."""
        low = int(np.searchsorted(self.start_ns + self.step_ns, first_ns, side="right"))
        high = int(np.searchsorted(self.start_ns, last_ns, side="right"))
        low = min(low, self.rows - 1)
        rows = slice(low, max(high, low + 1))
        parts = (self.value[rows], self.external_nt[rows], self.induced_nt[rows])
        return Index(self.name, self.format, self.start_ns[rows], self.step_ns, *parts, self.sha256)

    def to_bytes(self) -> bytes:
        """Return the intervals as the service keeps them beside the file, so that no job reads the file again."""
        sink = io.BytesIO()
        head = np.array([self.name, self.format, self.sha256, str(self.step_ns)])
        np.savez_compressed(
            sink, head=head, start=self.start_ns, value=self.value, external=self.external_nt, induced=self.induced_nt
        )
        return sink.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> Index:
        """Return what `to_bytes` made."""
        with np.load(io.BytesIO(content), allow_pickle=False) as table:
            name, kind, sha256, step = table["head"].tolist()
            columns = (table["value"], table["external"], table["induced"])
            return cls(name, kind, table["start"], int(step), *columns, sha256)

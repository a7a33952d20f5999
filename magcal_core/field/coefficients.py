"""Coefficients of a field as a file gives them: polynomials in time between breaks, and where they come from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds

MOST_DEGREE: Final = 250
ALWAYS_NS: Final = (-(2**62), 2**62 - 1)
"""Breaks of coefficients that do not change."""


@dataclass(frozen=True, eq=False)
class CoefficientFile:
    """Gauss coefficients of one file, Schmidt quasi-normalised at 6371.2 km.

    Attributes
    ----------
    name : str, optional
        The file's name.
    format : str
        Format of the file, as `magcal_core.field.coefficient_files.READERS` names it.
    model : str, optional
        Name of the model, where the file has one.
    sha256 : str
        Digest of the file.
    min_degree, max_degree, order : int
        Degrees that it has, and the order of its polynomials: 1 for constants, 2 for lines.
    breaks_ns : int64, shape (p + 1,)
        Ends of the polynomials, nanoseconds since 1970, UTC.
    g_nt, h_nt : shape (p, order, N + 1, N + 1)
        Coefficients g[n, m] and h[n, m], nT, by powers of the time since the break as a share of the way to the next.
    """

    name: str | None
    format: str
    model: str | None
    sha256: str
    min_degree: int
    max_degree: int
    order: int
    breaks_ns: Nanoseconds
    g_nt: Floats
    h_nt: Floats

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CoefficientFile) and self.sha256 == other.sha256

    def __hash__(self) -> int:
        return hash(self.sha256)

    @property
    def valid_from(self) -> np.datetime64 | None:
        """First instant of validity, UTC; None where it is valid always."""
        return None if self.is_always else np.datetime64(int(self.breaks_ns[0]), "ns")

    @property
    def valid_until(self) -> np.datetime64 | None:
        """Last instant of validity, UTC; None where it is valid always."""
        return None if self.is_always else np.datetime64(self.last_ns, "ns")

    @property
    def last_ns(self) -> int:
        """Last instant of validity, nanoseconds since 1970: that of constants holds for a nanosecond."""
        return int(self.breaks_ns[-1]) - (self.order == 1)

    @cached_property
    def is_always(self) -> bool:
        """Whether the coefficients do not change."""
        return tuple(self.breaks_ns.tolist()) == ALWAYS_NS

    def to_dict(self) -> dict[str, object]:
        """Return what the record has of the file."""
        return {
            "name": self.name,
            "format": self.format,
            "model": self.model,
            "sha256": self.sha256,
            "degrees": [self.min_degree, self.max_degree],
            "order": self.order,
            "valid_from": _text(self.valid_from),
            "valid_until": _text(self.valid_until),
        }


def _text(t_utc: np.datetime64 | None) -> str | None:
    return None if t_utc is None else f"{np.datetime_as_string(t_utc, unit='us')}Z"

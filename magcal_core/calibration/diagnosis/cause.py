"""Why a fit is refused, or leaves more than noise: the causes in their order, the first that holds ends the search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_NO_FAULT: Final = frozenset({"unexplained", "bad_rows"})
_MUCH: Final = 0.01
"""Share of the field that a fit must leave before no number is given for another reference's sake."""
_FAR_BETTER: Final = 3.0


@dataclass(frozen=True, slots=True)
class Named:
    """A cause in short: its code and a text."""

    code: str
    text: str

    def to_dict(self) -> dict[str, object]:
        """Return it as the records have it."""
        return {"code": self.code, "text": self.text}


@dataclass(frozen=True, slots=True)
class Finding:
    """A cause that was found.

    Attributes
    ----------
    value, unit : what was measured, such as the seconds to add to the clock.
    ratio : by how much the cause lowers the capped residual, where one was tried; else value over limit.
    alternatives : what explains the data nearly as well.
    """

    code: str
    text: str
    value: float | str | None
    unit: str | None
    ratio: float | None
    alternatives: tuple[Named, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return the finding as the records have it."""
        return {
            "code": self.code,
            "text": self.text,
            "value": self.value,
            "unit": self.unit,
            "ratio": self.ratio,
            "alternatives": [one.to_dict() for one in self.alternatives],
        }


@dataclass(frozen=True, slots=True)
class Tried:
    """A candidate that was tried, and what it leaves, as a share of the field."""

    code: str
    text: str
    residual_share: float

    def to_dict(self) -> dict[str, object]:
        """Return the candidate as the records have it."""
        return {"code": self.code, "text": self.text, "residual_share": self.residual_share}


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What is wrong with the input of a calibration; nothing of it is applied.

    ``residual_share``: robust scale that the best sensor leaves, as a share of the field; ``inlier_share``: share of
    the rows within five scales. Both None where no sensor was found.
    """

    residual_share: float | None
    inlier_share: float | None
    findings: tuple[Finding, ...] = ()
    candidates: tuple[Tried, ...] = ()

    @property
    def cause(self) -> Finding | None:
        """The first finding, where there is one."""
        return self.findings[0] if self.findings else None

    @property
    def fault(self) -> Finding | None:
        """The cause, where it is a fault of the input that a fit cannot mend: not bad rows, nor one without a name."""
        return None if self.cause is None or self.cause.code in _NO_FAULT else self.cause

    @property
    def is_certain(self) -> bool:
        """Whether the fault is beyond doubt: the given reference leaves much, and another explains it far better."""
        fault, share = self.fault, self.residual_share
        if fault is None:
            return False
        if share is None:
            return fault.code != "unit"
        return share >= _MUCH and fault.ratio is not None and fault.ratio >= _FAR_BETTER

    def to_dict(self) -> dict[str, object]:
        """Return the diagnosis as the records have it."""
        return {
            "residual_share": self.residual_share,
            "inlier_share": self.inlier_share,
            "findings": [one.to_dict() for one in self.findings],
            "candidates": [one.to_dict() for one in self.candidates],
        }

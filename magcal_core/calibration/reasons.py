"""The verdict in one word and its reasons: a code and a text each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Reason:
    """One machine-readable reason of a verdict."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What magcal says of a parameter set in one word, ``accept``, ``weak`` or ``refuse``, with the reasons."""

    grade: str
    reasons: tuple[Reason, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the verdict as the records of the service have it."""
        return {"grade": self.grade, "reasons": [f"{reason.code}: {reason.text}" for reason in self.reasons]}

"""Which object of a launch a session is of: the one whose orbit leaves the smallest residuals.

Notes
-----
The session is calibrated with the orbits of each object in turn, its clock as it is: objects of one launch follow each
other along one track, and an estimated clock would make one of the other. The objects are ranked by their residual,
1.4826 times the median of its size. The first is distinguished from the others where its residuals are the smaller
ones in stretches of equal time beyond what chance does: the mean of the twelve differences is more than three times
its error, each residual counted up to five scales of the first's, so that bad rows decide nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from magcal_core.errors import EstimationError, InputError, MagcalError, PropagationError
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.orbit.sources import OrbitSource
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples

MOST_SAMPLES: Final = 400
"""Samples, evenly spaced, that the objects are distinguished by."""
MOST_OBJECTS: Final = 200
EXPLAINS: Final = 0.02
"""An object explains a session whose residual is below this share of the field."""
BLOCKS: Final = 12
SURE: Final = 3.0
"""Standard errors by which the first object must be better than another one."""
FAR: Final = 5.0
"""Scales of the first object's residuals up to which a residual counts in that comparison."""
_OPTIONS: Final[Mapping[str, object]] = {
    "method": "scalar", "noise_model": "none", "time_offset": "none", "regressors": (),
}  # fmt: skip
"""What differs from the defaults of a calibration; its loss is theirs: none where rows are clean under an orbit."""


@dataclass(frozen=True, slots=True)
class ObjectMatch:
    """One object, and how well its orbits explain a session.

    Attributes
    ----------
    norad_id, cospar_id, name : str
        "" where the orbits do not have them.
    epoch : str
        Epoch of the orbit nearest to the session, ISO 8601, UTC.
    age_days : float
        Its distance from the middle of the session, days.
    residual_nt : float, optional
        1.4826 times the median size of the residual, nT; None where the session cannot be calibrated with it.
    behind_first : float, optional
        By how many standard errors its residuals are larger than those of the first; None for the first itself.
    reason : str, optional
        Why it has no residual.
    """

    norad_id: str
    cospar_id: str
    name: str
    epoch: str
    age_days: float
    residual_nt: float | None
    behind_first: float | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class WhichObject:
    """Which object a session is of.

    Attributes
    ----------
    state : str
        ``told``: the first of ``objects`` is it; ``ambiguous``: others explain it about as well; ``none``: no object
        explains it.
    text : str
        The same in words.
    objects : tuple of ObjectMatch
        The smallest residual first.
    """

    state: Literal["told", "ambiguous", "none"]
    text: str
    objects: tuple[ObjectMatch, ...]

    def to_dict(self) -> dict[str, object]:
        """Return the same as JSON has it."""
        return {"state": self.state, "text": self.text, "objects": [asdict(one) for one in self.objects]}


def which_object(samples: Samples, sources: Sequence[OrbitSource], *, max_orbit_age_days: float = 14.0) -> WhichObject:
    """Return which of the objects whose orbits are given a session is of.

    Parameters
    ----------
    samples : Samples
        One session; a reference in it is not used.
    sources : sequence of OrbitSource
        Orbits of all objects of a launch, as `parse_sources` reads them; orbits of one NORAD id (else COSPAR id, else
        name) are of one object.
    max_orbit_age_days : float
        Refuse orbits further from the session, days.

    Raises
    ------
    InputError
        There are fewer than two objects, or more than `MOST_OBJECTS`, or the session has no usable sample.
    """
    groups: dict[str, list[OrbitSource]] = {}
    for number, source in enumerate(sources):
        groups.setdefault(source.norad_id or source.cospar_id or source.name or f"orbit {number + 1}", []).append(
            source
        )
    if not 2 <= len(groups) <= MOST_OBJECTS:
        raise InputError(f"the orbits are of {len(groups)} objects; want 2 to {MOST_OBJECTS}")
    some = _some(samples)
    options = CalibrationOptions.from_dict({**_OPTIONS, "max_orbit_age_days": max_orbit_age_days})
    tried = [_tried(some, group, options) for group in groups.values()]
    known = sorted((one for one in tried if one.residuals_nt is not None), key=lambda one: one.scale_nt)
    failed = [one.match for one in tried if one.residuals_nt is None]
    ranked = [one.compared(known[0]) if i else one.match for i, one in enumerate(known)]
    return _judged(tuple(ranked), tuple(failed), known[0].field_nt if known else np.inf)


def _some(samples: Samples) -> Samples:
    """Return evenly spaced usable samples without what would make an orbit unnecessary."""
    rows = np.flatnonzero(samples.is_used)
    if not rows.size:
        raise InputError("the session has no usable sample")
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_SAMPLES)).astype(np.intp)]
    taken = samples.take(chosen)
    return Samples(t_utc=taken.t_utc, h_nt=taken.h_nt)


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """One object with the residuals that it leaves, shape (n,), nT; None where there is no fit."""

    match: ObjectMatch
    residuals_nt: NDArray[np.float64] | None
    field_nt: float = np.inf

    @property
    def scale_nt(self) -> float:
        return np.inf if self.match.residual_nt is None else self.match.residual_nt

    def compared(self, first: _Tried) -> ObjectMatch:
        """Return the match with the standard errors by which it is behind the first."""
        if self.residuals_nt is None or first.residuals_nt is None:
            return self.match
        # What lies far under both orbits is a bad row: it says nothing of either.
        most_nt = FAR * max(first.scale_nt, 1e-9 * first.field_nt)
        worse = np.minimum(np.abs(self.residuals_nt), most_nt) - np.minimum(np.abs(first.residuals_nt), most_nt)
        means = np.array([np.nanmean(block) for block in np.array_split(worse, BLOCKS) if np.isfinite(block).any()])
        error = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else np.inf
        behind = float(np.mean(means) / error) if error > 0.0 else 0.0
        values = asdict(self.match) | {"behind_first": round(behind, 2)}
        return ObjectMatch(**values)


def _tried(samples: Samples, group: Sequence[OrbitSource], options: CalibrationOptions) -> _Tried:
    middle = samples.t_utc[len(samples) // 2]
    nearest = min(group, key=lambda source: abs(source.epoch_utc - middle))
    about = (nearest.norad_id, nearest.cospar_id, nearest.name)
    epoch = f"{np.datetime_as_string(nearest.epoch_utc, unit='ms')}Z"
    age_days = round(float(abs(nearest.epoch_utc - middle) / np.timedelta64(1, "s")) / 86_400.0, 4)
    orbits: list[Orbit] = [source.orbit for source in group]
    try:
        found = calibrate(samples, orbits, options)
    except (InputError, EstimationError, PropagationError) as error:
        return _Tried(ObjectMatch(*about, epoch, age_days, None, reason=_reason(error)), None)
    residuals_nt = found.residuals.residual_nt
    scale_nt = 1.4826 * float(np.nanmedian(np.abs(residuals_nt)))
    field_nt = float(np.nanmedian(found.residuals.model_nt))
    return _Tried(ObjectMatch(*about, epoch, age_days, round(scale_nt, 3)), residuals_nt, field_nt)


def _reason(error: MagcalError) -> str:
    return f"{error.code}: {error.message}"[:300]


def _judged(ranked: tuple[ObjectMatch, ...], failed: tuple[ObjectMatch, ...], field_nt: float) -> WhichObject:
    objects = (*ranked, *failed)
    first = ranked[0] if ranked else None
    if first is None or first.residual_nt is None or first.residual_nt > EXPLAINS * field_nt:
        said = "" if first is None else f": the nearest, {_called(first)}, leaves {first.residual_nt:.0f} nT"
        return WhichObject("none", f"none of the {len(objects)} objects explains the session{said}", objects)
    near = [one for one in ranked[1:] if one.behind_first is not None and one.behind_first < SURE]
    said = f"{_called(first)} leaves {first.residual_nt:.1f} nT"
    if near:
        others = ", ".join(f"{_called(one)} {one.residual_nt:.1f} nT" for one in near[:5])
        more = f" and {len(near) - 5} more" if len(near) > 5 else ""
        return WhichObject("ambiguous", f"{said}, and about as little: {others}{more}", objects)
    second = f", the next, {_called(ranked[1])}, {ranked[1].residual_nt:.1f} nT" if len(ranked) > 1 else ""
    return WhichObject("told", said + second, objects)


def _called(one: ObjectMatch) -> str:
    return " ".join(part for part in (one.norad_id or one.cospar_id, one.name) if part) or "an object without a name"

"""Which parameter sets a trend is made of: read from their records, the others left out with a reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.registry import is_vector_method
from magcal_core.errors import InputError, OptionError, TimeError, TooFewSetsError
from magcal_core.numerics.linear_algebra import unit_diagonal
from magcal_core.sensor.parameters import GROUPS, SENSOR_NAMES
from magcal_core.sensor.regressors import is_step
from magcal_core.telemetry.iso_times import parse_iso_ns

FEWEST: Final = 3
"""With two sets the prior decides how far a forecast may be off."""
_SAME_DATA: Final = 0.1
"""Share of the shorter span that two sets may have in common."""


class HasRecord(Protocol):
    """A calibration: what has a parameter set's record."""

    def to_dict(self) -> dict[str, object]:
        """Return the record."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class DatedSet:
    """A parameter set as a trend sees it.

    Attributes
    ----------
    label : its id, or the beginning of its data where it has none.
    owner : satellite and magnetometer, as far as the record names them.
    from_ns, until_ns, time_ns : span of its data and the time it stands for, ns since 1970, UTC.
    made : when it was made, as text; empty where the record does not say.
    kind : vector or not, and its regressors.
    parameters : shape (9,), in the order of `parameter_names` of a set.
    covariance : shape (9, 9), None where the set has none.
    rank : what else tells it from sets of the same time.
    """

    label: str
    owner: tuple[str, str]
    from_ns: int
    until_ns: int
    time_ns: int
    made: str
    is_active: bool
    is_refused: bool
    kind: tuple[bool, frozenset[str]]
    parameters: Floats
    covariance: Floats | None
    rank: tuple[float, ...]

    @property
    def order(self) -> tuple[object, ...]:
        """What the sets are sorted by: time first, and whatever else tells them apart."""
        return (self.time_ns, self.from_ns, self.until_ns, self.made, self.label, self.rank)


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """The sets that count, in the order of time, the set whose life is given, and what was left out, with reasons."""

    sets: tuple[DatedSet, ...]
    active: DatedSet
    left_out: tuple[tuple[str, str], ...]
    every: tuple[DatedSet, ...]


def choose_sets(sets: Iterable[Mapping[str, object] | HasRecord]) -> Chosen:
    """Return the sets that count.

    Raises
    ------
    InputError
        A record is no parameter set.
    OptionError
        The sets are of several magnetometers, or one that counts has no usable covariance.
    TooFewSetsError
        Fewer than three count.
    """
    every = sorted((_dated(one if isinstance(one, Mapping) else one.to_dict()) for one in sets), key=lambda s: s.order)
    if len({one.owner for one in every if any(one.owner)}) > 1:
        raise OptionError("the sets are of several magnetometers: a trend is that of one")
    good = [one for one in every if not one.is_refused]
    active = next((one for one in reversed(every) if one.is_active), good[-1] if good else None)
    left_out = [(one.label, "refused") for one in every if one.is_refused]
    left_out += [(one.label, "other_kind") for one in good if active is not None and one.kind != active.kind]
    same_kind = [one for one in good if active is not None and one.kind == active.kind]
    counted = _apart(same_kind)
    left_out += [(one.label, "same_data") for one in same_kind if all(one is not other for other in counted)]
    if active is None or len(counted) < FEWEST:
        raise TooFewSetsError(f"{len(counted)} parameter sets count, {FEWEST} are needed: {_why(len(every), left_out)}")
    for one in counted:
        _require_covariance(one)
    newest = active if active.is_active else counted[-1]
    return Chosen(tuple(counted), newest, tuple(left_out), tuple(every))


def _why(count: int, left_out: Sequence[tuple[str, str]]) -> str:
    if not left_out:
        return f"there are {count}"
    reasons = [reason for _, reason in left_out]
    told = ", ".join(f"{reasons.count(reason)} {reason}" for reason in dict.fromkeys(reasons))
    return f"of {count}, left out are {told}"


def _apart(sets: Sequence[DatedSet]) -> list[DatedSet]:
    """Return, of sets with data in common, one: the active one, else the one made last."""
    kept: list[DatedSet] = []
    for one in sorted(sets, key=lambda s: (s.is_active, s.made, s.order), reverse=True):
        if not any(_is_same_data(one, other) for other in kept):
            kept.append(one)
    return sorted(kept, key=lambda s: s.order)


def _is_same_data(one: DatedSet, other: DatedSet) -> bool:
    if (one.from_ns, one.until_ns) == (other.from_ns, other.until_ns):
        return True
    common = min(one.until_ns, other.until_ns) - max(one.from_ns, other.from_ns)
    return common > _SAME_DATA * min(one.until_ns - one.from_ns, other.until_ns - other.from_ns)


def _require_covariance(one: DatedSet) -> None:
    if one.covariance is None:
        raise OptionError(f"parameter set {one.label} has no covariance: a trend needs that of every set that counts")
    try:
        np.linalg.cholesky(unit_diagonal(one.covariance)[0])
    except np.linalg.LinAlgError as error:
        raise OptionError(f"the covariance of parameter set {one.label} is not positive definite") from error


def _dated(record: Mapping[str, object]) -> DatedSet:
    """Return what a trend needs of a parameter set's record."""
    try:
        values, verdict = record["parameters"], record["verdict"]
        if not isinstance(values, Mapping) or not isinstance(verdict, Mapping):
            raise InputError("the record is no parameter set: parameters and verdict are not mappings")
        parameters = np.array([v for group in GROUPS for v in values[group]], np.float64)
        regressors = [str(name) for name in values.get("regressors") or {}]
        from_ns, until_ns = (parse_iso_ns(str(record[name])) for name in ("data_from", "data_until"))
        covariance = _covariance(record)
    except (KeyError, TypeError, ValueError, TimeError) as error:
        raise InputError(f"the record is no parameter set: {error}") from error
    if parameters.shape != (9,) or not np.isfinite(parameters).all() or not parameters[3:6].all():
        raise InputError("the record is no parameter set: its nine parameters are not nine numbers, the scale not zero")
    if until_ns < from_ns:
        raise InputError("the record is no parameter set: its data end before they begin")
    has_steps = any(map(is_step, regressors))
    return DatedSet(
        label=str(record.get("id") or record["data_from"]),
        owner=(str(record.get("satellite", "")), str(record.get("magnetometer", ""))),
        from_ns=from_ns,
        until_ns=until_ns,
        time_ns=until_ns if has_steps else from_ns + (until_ns - from_ns) // 2,
        made=str(record.get("created_at") or ""),
        is_active=record.get("status") == "active",
        is_refused=verdict.get("grade") == "refuse",
        kind=(
            is_vector_method(record.get("method")),
            frozenset(name for name in regressors if not is_step(name)),
        ),
        parameters=parameters,
        covariance=covariance,
        rank=(*parameters.tolist(), *([] if covariance is None else covariance.ravel().tolist())),
    )


def _covariance(record: Mapping[str, object]) -> Floats | None:
    """Return the covariance of the nine, shape (9, 9); None where there is none, or not all of it is numbers."""
    told = record.get("covariance")
    if not isinstance(told, Sequence) or not told:
        return None
    whole = np.array(told, np.float64)
    names = record.get("parameter_names")
    order = [str(name) for name in names] if isinstance(names, Sequence) else list(SENSOR_NAMES)
    if whole.ndim != 2 or whole.shape != (len(order), len(order)):
        raise ValueError(f"the covariance has the shape {whole.shape}, there are {len(order)} parameter names")
    if any(name not in order for name in SENSOR_NAMES):
        return None
    index = [order.index(name) for name in SENSOR_NAMES]
    found = whole[np.ix_(index, index)]
    return 0.5 * (found + found.T) if np.isfinite(found).all() else None

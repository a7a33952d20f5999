"""Which columns may be regressors, and the terms that are made of them: lags, triples, and responses of the sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.sensor.regressors import lag_of, lagged, lagged_name

FUNCTION_OF_FIELD: Final = 0.98
"""R^2 on the reading from which a column is a function of the field: other magnetometers have 0.977 to 1."""
REFERENCE_COLUMN: Final = 0.99
"""R^2 on the reference from which a column is a reference itself."""
ENOUGH: Final = 0.95
"""Share of the samples that a column must have a value for."""
LAGS: Final = (0, 1, -1, 2, -2)
RESPONSES: Final = ("h^2", "h^3", "dh/dt")
_GROUP: Final = "*"
_RARE: Final = 0.02
_MONOTONE: Final = 0.99
_TIME: Final = 0.98
_QUATERNION: Final = (1e-3, 0.95)
_BLOCKS: Final = 6
_MOST: Final = 3000
_STEMS: Final = (("0", "1", "2"), ("x", "y", "z"), ("1", "2", "3"), ("X", "Y", "Z"))


@dataclass(frozen=True, slots=True)
class RegressorCandidate:
    """A column, why it may not be a regressor (None where it may), and its R^2 on the field where that was asked."""

    name: str
    excluded: str | None
    r2: float | None

    def to_dict(self) -> dict[str, object]:
        """Return the candidate as the records have it."""
        return {"name": self.name, "excluded": self.excluded, "r2": self.r2}


@dataclass(frozen=True, slots=True, eq=False)
class FieldBeside:
    """What columns are held against: times, s, readings, nT, and reference, |B| and components as far as known, nT."""

    t_s: Floats
    h_nt: Floats
    references_nt: Sequence[Floats]


def regressor_candidates(columns: Mapping[str, Floats], beside: FieldBeside) -> tuple[RegressorCandidate, ...]:
    """Return of each of ``columns``, name -> shape (n,), whether it may be a regressor.

    Notes
    -----
    R^2 is that of six blocks of time, each predicted from the others, on {1, h, |h|, products of h} and on
    {1, components of the reference, |B|}. These stay out of the first basis: a temperature is a function of the orbit.
    """
    step = max(1, len(beside.t_s) // _MOST)
    some = slice(None, None, step)
    bases = _bases(beside, some)
    found = [_candidate(name, np.asarray(column, np.float64), beside, bases, some) for name, column in columns.items()]
    found = _without_quaternions(found, columns)
    return tuple(_without_thirds(found))


def _bases(beside: FieldBeside, some: slice) -> list[tuple[str, float, Floats]]:
    h = beside.h_nt[some] / max(float(np.median(np.abs(beside.h_nt))), 1e-9)
    products = [h[:, i] * h[:, j] for i in range(3) for j in range(i, 3)]
    own = np.column_stack([np.ones(len(h)), h, np.linalg.norm(h, axis=1), *products])
    found = [("function_of_field", FUNCTION_OF_FIELD, own)]
    if beside.references_nt:
        parts = [np.asarray(one)[some].reshape(len(h), -1) for one in beside.references_nt]
        scale = max(float(np.median(np.abs(parts[0]))), 1e-9)
        found.append(
            ("reference_column", REFERENCE_COLUMN, np.column_stack([np.ones(len(h)), *(one / scale for one in parts)]))
        )
    return found


def _candidate(
    name: str, column: Floats, beside: FieldBeside, bases: list[tuple[str, float, Floats]], some: slice
) -> RegressorCandidate:
    is_known = np.isfinite(column)
    known = column[is_known]
    if known.size < ENOUGH * column.size or not known.size or np.ptp(known) == 0.0:
        return RegressorCandidate(name, "incomplete_or_constant", None)
    values, counts = np.unique(known, return_counts=True)
    if len(values) <= 3 and counts.min() < _RARE * known.size:
        return RegressorCandidate(name, "flag", None)
    steps = np.diff(known)
    share = max(float(np.mean(steps >= 0)), float(np.mean(steps <= 0)))
    if share >= _MONOTONE and abs(float(np.corrcoef(known, beside.t_s[is_known])[0, 1])) > _TIME:
        return RegressorCandidate(name, "counter_or_time", None)
    largest = None
    for code, limit, basis in bases:
        r2 = _unseen_r2(basis, column[some])
        largest = r2 if largest is None else max(largest, r2)
        if r2 > limit:
            return RegressorCandidate(name, code, r2)
    return RegressorCandidate(name, None, largest)


def _unseen_r2(basis: Floats, column: Floats) -> float:
    """Return the share of a column's variance that ``basis`` predicts in blocks that it was not fitted to."""
    known = np.flatnonzero(np.isfinite(column))
    basis, target = basis[known], column[known]
    block = np.arange(len(target)) * _BLOCKS // max(len(target), 1)
    left = 0.0
    for one in range(_BLOCKS):
        seen, unseen = block != one, block == one
        if not unseen.any() or np.count_nonzero(seen) <= basis.shape[1]:
            return 0.0
        found = np.linalg.lstsq(basis[seen], target[seen], rcond=1e-10)[0]
        left += float(np.sum((target[unseen] - basis[unseen] @ found) ** 2))
    total = float(np.sum((target - target.mean()) ** 2))
    return max(1.0 - left / total, 0.0) if total > 0 else 0.0


def _without_quaternions(found: list[RegressorCandidate], columns: Mapping[str, Floats]) -> list[RegressorCandidate]:
    """Exclude four neighbours that together are a unit quaternion."""
    names, out = list(columns), {one.name: one for one in found}
    for i in range(len(names) - 3):
        four = np.column_stack([np.asarray(columns[name], np.float64) for name in names[i : i + 4]])
        size = np.linalg.norm(four[np.isfinite(four).all(axis=1)], axis=1)
        is_moving = np.ptp(four, axis=0) > 0
        if size.size and is_moving.any() and np.mean(np.abs(size - 1.0) <= _QUATERNION[0]) >= _QUATERNION[1]:
            for name in names[i : i + 4]:
                out[name] = RegressorCandidate(name, "quaternion", out[name].r2)
    return [out[one.name] for one in found]


def _without_thirds(found: list[RegressorCandidate]) -> list[RegressorCandidate]:
    """Exclude the third of three columns of one stem whose other two are functions of the field or references."""
    by_name = {one.name: one for one in found}
    for triple in triples(list(by_name)):
        codes = [by_name[name].excluded for name in triple]
        outside = [code for code in codes if code in ("function_of_field", "reference_column")]
        if len(outside) == 2:
            for name in triple:
                if by_name[name].excluded is None:
                    by_name[name] = RegressorCandidate(name, outside[0], by_name[name].r2)
    return [by_name[one.name] for one in found]


def triples(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return three columns of one stem each: ``torque_0`` to ``torque_2``, ``mtq_x`` to ``mtq_z``."""
    known, found = set(names), []
    for name in names:
        for ends in _STEMS:
            if name.endswith(ends[0]):
                stem = name[: -len(ends[0])]
                three = (stem + ends[0], stem + ends[1], stem + ends[2])
                if known.issuperset(three) and stem and three not in found:
                    found.append(three)
    return found


def expanded(names: Sequence[str], columns: Sequence[str]) -> tuple[str, ...]:
    """Return regressors with groups such as ``torque_*@1`` in full; what is no group stays as it is."""
    found: list[str] = []
    for name in names:
        source, lag = lag_of(name)
        three = None
        if source.endswith(_GROUP):
            three = next((one for one in triples(columns) if one[0].startswith(source.removesuffix(_GROUP))), None)
        found += [name] if three is None else [lagged_name(one, lag) for one in three]
    return tuple(dict.fromkeys(found))


def offered_columns(
    columns: Mapping[str, Floats], candidates: Sequence[RegressorCandidate], t_s: Floats
) -> dict[str, Floats]:
    """Return every column that may be a regressor at every lag; gaps are filled, for choosing alone."""
    found: dict[str, Floats] = {}
    for one in candidates:
        if one.excluded is not None:
            continue
        column = np.asarray(columns[one.name], np.float64)
        for lag in LAGS:
            found[lagged_name(one.name, lag)] = _filled(lagged(column, lag, t_s), t_s)
    return found


def _filled(column: Floats, t_s: Floats) -> Floats:
    known = np.isfinite(column)
    return column if known.all() else np.interp(t_s, t_s[known], column[known])

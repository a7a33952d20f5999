"""Which column is meant where one of magcal's names is missing: ``BX``, ``mag_x [nT]``, ``Magnetometer X``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Sequence
from typing import Final

_READING: Final = ("bx", "by", "bz")
_BRACKETS: Final = re.compile(r"\[[^\]]*\]|\([^)]*\)|\{[^}]*\}")
_WORDS: Final = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_SAID_BESIDE: Final = frozenset(
    {"nt", "ut", "mt", "mg", "gauss", "tesla", "nanotesla", "microtesla", "raw", "val", "value", "measured", "km"}
)
"""Words of a column's name that say its unit or that it is a reading."""
_AXES: Final = ("xyz", "012", "123")
_MAGNETIC: Final = ("mag", "mgm", "mtm", "field", "fgm", "fluxgate", "vfm", "bnec", "bvec", "bbody", "bsensor", "tam")
_OTHERS: Final = (
    "ref", "eci", "model", "igrf", "torq", "mtq", "mtr", "coil", "dipole", "gyro", "rate", "acc", "sun", "pos", "vel",
    "wheel", "quat", "status", "flag", "temp", "cmd", "moment", "current",
)  # fmt: skip
"""Parts of names that three columns have which are no readings of a magnetometer."""
_TIMES: Final = (
    "time", "timeutc", "utctime", "utc", "timestamp", "datetime", "datetimeutc", "ts", "epoch", "epochutc",
    "unixtime", "isotime", "gpstime", "obt", "met", "sclk", "date", "t",
)  # fmt: skip
_DATES: Final = ("date", "day", "dateutc", "utcdate", "datum")


def suggested(name: str, own: str, columns: Sequence[str], taken: Collection[str]) -> str | None:
    """Return the column that may be the missing one, None where none is near.

    Parameters
    ----------
    name : the standard name.
    own : the name that was looked for.
    columns : the table's columns.
    taken : columns that have been found to be something else.
    """
    free = [column for column in columns if column and column not in taken]
    keys = {column: _key(column) for column in free}
    same = [column for column in free if keys[column] == _key(own)]
    if same:
        return same[0]
    if name == "time" and own == name:
        known = [column for column in free if keys[column] in _TIMES]
        return min(known, key=lambda column: _TIMES.index(keys[column])) if known else None
    if name in _READING and own == name:
        triple = _reading(keys)
        if triple is not None:
            return triple[_READING.index(name)]
    close = difflib.get_close_matches(own.casefold(), [column.casefold() for column in free], n=1, cutoff=0.6)
    return next((column for column in free if close and column.casefold() == close[0]), None)


def date_beside(time: str, columns: Sequence[str]) -> dict[str, str]:
    """Return how the column map names the date, where a table has a column for it beside its column ``time``."""
    dates = [column for column in columns if column != time and _key(column) in _DATES]
    return {"date": dates[0]} if dates else {}


def _key(column: str) -> str:
    """Return a name without brackets, units, case and separators."""
    words = _WORDS.findall(_BRACKETS.sub(" ", column))
    kept = [word.lower() for word in words if word.lower() not in _SAID_BESIDE]
    return "".join(kept or [word.lower() for word in words])


def _reading(keys: dict[str, str]) -> tuple[str, str, str] | None:
    """Return the three columns that are most likely a magnetometer's, None where no three are."""
    columns = {key: column for column, key in reversed(keys.items())}
    stems = dict.fromkeys(key[:-1] for key in keys.values() if key)
    found: list[tuple[int, tuple[str, str, str]]] = []
    for stem in stems:
        for axes in _AXES:
            names = [f"{stem}{axis}" for axis in axes]
            rank = _rank(stem, axes)
            if rank is not None and all(name in columns for name in names):
                found.append((rank, (columns[names[0]], columns[names[1]], columns[names[2]])))
    return min(found, key=lambda one: one[0])[1] if found else None


def _rank(stem: str, axes: str) -> int | None:
    """Return how likely three columns of a stem are readings, 0 the most, None where they are not."""
    if any(part in stem for part in _OTHERS):
        return None
    if stem in ("b", "h"):
        return 0
    if any(part in stem for part in _MAGNETIC):
        return 1
    if stem.endswith("b") and axes == "xyz":
        return 2
    return 3 if stem in ("", "m") and axes == "xyz" else None

"""What each column of a table is taken for, what is missing, and which column may be meant: told, not refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from magcal_core.telemetry.column_suggestions import date_beside, suggested
from magcal_core.telemetry.columns import READING, STANDARD, TIME, ColumnMap, checked_map, taken_columns
from magcal_core.telemetry.time_forms import TimeForm, time_columns


@dataclass(frozen=True, slots=True)
class ColumnRoles:
    """What the columns of one table are taken for.

    Attributes
    ----------
    taken : own name -> name in magcal; every other column is housekeeping under its own name.
    missing : needed names for which there is no column.
    suggested : name in magcal -> the column that may be meant.
    times : own names of the columns that the times stand in.
    """

    taken: Mapping[str, str]
    missing: Sequence[str]
    suggested: Mapping[str, str]
    times: Sequence[str]


def column_roles(header: Sequence[str], columns: ColumnMap | None, form: TimeForm) -> ColumnRoles:
    """Return what the columns ``header`` are taken for under the column map ``columns``.

    Raises
    ------
    OptionError
        The column map is malformed, or declares another form of time than ``form``.
    """
    mapped = checked_map(columns)
    times = time_columns(form, mapped)
    found = taken_columns(header, mapped, times)
    renamed = {own: name for name, own in mapped.items() if name not in STANDARD and own in header and own not in found}
    has_time = all(own in header for own in times.own.values())
    missing = ([] if has_time else [TIME]) + [name for name in READING if name not in found.values()]
    near: dict[str, str] = {}
    for name in missing:
        # A map that names a column which is not there says nothing of this table: the name itself is looked for.
        close = suggested(name, mapped.get(name, name), header, found) or suggested(name, name, header, found)
        near |= {} if close is None else {name: close}
        near |= date_beside(close, header) if name == TIME and close is not None else {}
    stand_in = [own for own in times.own.values() if own in header]
    return ColumnRoles(found | renamed, missing, near, stand_in)

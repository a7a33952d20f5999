"""Which column of a table means what: the standard names, the magnetometer's own names, and the rest."""

from __future__ import annotations

import json
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from magcal_core.errors import OptionError, TelemetryFormatError
from magcal_core.telemetry.column_suggestions import date_beside, suggested
from magcal_core.telemetry.faults import FaultList, quoted
from magcal_core.telemetry.time_forms import ISO, TimeColumns, TimeForm, time_columns
from magcal_core.telemetry.validity import Validity

TIME: Final = "time"
READING: Final = ("bx", "by", "bz")
ATTITUDE: Final = ("qw", "qx", "qy", "qz")
REFERENCE_BASE: Final = ("ref_bx", "ref_by", "ref_bz")
REFERENCE_GCRF: Final = ("ref_eci_x", "ref_eci_y", "ref_eci_z")
REFERENCE_MAGNITUDE: Final = ("ref_b",)
POSITION: Final = ("x_km", "y_km", "z_km")
GROUPS: Final = (ATTITUDE, REFERENCE_BASE, REFERENCE_GCRF, REFERENCE_MAGNITUDE, POSITION)
"""Columns that come together or not at all."""
STANDARD: Final = (TIME, *READING, *(name for group in GROUPS for name in group))
RESERVED: Final = "magcal_flags"
"""Column that magcal writes beside exported samples and does not read."""

MAX_COLUMNS: Final = 512
MAX_NAME_LENGTH: Final = 200

ColumnMap = Mapping[str, str]
"""Standard (or housekeeping) name -> the table's own name."""


@dataclass(frozen=True, slots=True)
class TableForm:
    """What is declared of a table beside the names of its columns.

    Attributes
    ----------
    times : how its times are written.
    validity : the column that says which readings are good, None where there is none.
    """

    times: TimeForm = ISO
    validity: Validity | None = None


PLAIN: Final = TableForm()
"""Nothing is declared."""


@dataclass(frozen=True, slots=True)
class ColumnPlan:
    """What is taken from a table.

    Attributes
    ----------
    names : own name -> name in magcal
        The standard columns that the table has, ``time`` included: it is the name of every part of the time.
    housekeeping : own name -> name in magcal
        Every other column; it is kept where it turns out to be numeric.
    times : TimeColumns
        Where the times stand, and how they are written.
    validity : Validity, optional
        The column that says which readings are good.
    """

    names: Mapping[str, str]
    housekeeping: Mapping[str, str]
    times: TimeColumns = field(default_factory=lambda: TimeColumns(ISO, {TIME: TIME}))
    validity: Validity | None = None

    @property
    def time(self) -> str:
        """The table's own name of the time column."""
        return next(own for own, name in self.names.items() if name == TIME)

    @property
    def numbers(self) -> dict[str, str]:
        """The standard columns but for the time: own name -> name in magcal."""
        return {own: name for own, name in self.names.items() if name != TIME}


def own_names(columns: ColumnMap) -> dict[str, str]:
    """Return standard name -> own name, for every standard column, whether the table has it or not."""
    return {name: columns.get(name, name) for name in STANDARD}


def checked_map(columns: ColumnMap | None) -> dict[str, str]:
    """Return the column map, checked.

    Raises
    ------
    OptionError
        A name is empty or not text, or two columns are mapped to one.
    """
    given = {} if columns is None else dict(columns)
    for name, own in given.items():
        if not isinstance(name, str) or not isinstance(own, str) or not name or not own.strip():
            raise OptionError(f"column map: {name!r} -> {own!r} is not a pair of names")
    owners = {name: _normal(own) for name, own in given.items()}
    for own, count in Counter(owners.values()).items():
        if count > 1:
            raise OptionError(f"column map: {count} columns are mapped to {own!r}")
    return owners


def plan_columns(
    header: Sequence[str], columns: ColumnMap | None, *, table: str, form: TableForm = PLAIN
) -> ColumnPlan:
    """Return what to take from a table with this ``header``, whose names are stripped.

    Raises
    ------
    TelemetryFormatError
        A column is missing, doubled or badly named; each one is a fault.
    OptionError
        The column map is malformed.
    """
    if len(header) > MAX_COLUMNS:
        raise TelemetryFormatError(f"the {table} has {len(header)} columns; the limit is {MAX_COLUMNS}")
    mapped = checked_map(columns)
    faults = FaultList(table)
    _check_names(header, faults)
    present = {name for name in header if name}
    times = time_columns(form.times, mapped)
    names = taken_columns(header, mapped, times)
    validity = form.validity
    if validity is not None and validity.column not in present:
        faults.add(TelemetryFormatError, f"column {validity.column}", "missing: it is to say which readings are valid")
    _check_missing(names, times, mapped, header, faults)
    faults.raise_if_any()
    renamed = {own: name for name, own in mapped.items() if name not in STANDARD}
    aside = {RESERVED, "" if validity is None else validity.column}
    rest = [own for own in header if own and own not in names and own not in aside]
    housekeeping = {own: renamed.get(own, own) for own in rest if renamed.get(own, own) not in STANDARD}
    return ColumnPlan(names, housekeeping, times, validity)


def taken_columns(header: Sequence[str], mapped: ColumnMap, times: TimeColumns) -> dict[str, str]:
    """Return own name -> standard name of the columns that are taken for something; ``mapped`` is checked."""
    present = {name for name in header if name}
    names = {own: TIME for own in times.own.values() if own in present}
    names |= {
        own: name
        for name, own in own_names(mapped).items()
        if name != TIME and own in present and own not in names and _is_free(name, own, mapped)
    }
    return names


def normal_header(header: Sequence[str]) -> list[str]:
    """Return the header's names, stripped and in Unicode's composed form."""
    return [_normal(name) for name in header]


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name.strip())


def _is_free(name: str, own: str, mapped: ColumnMap) -> bool:
    """Return whether ``own`` is not claimed by another name of the map."""
    return name in mapped or own not in mapped.values()


def _check_names(header: Sequence[str], faults: FaultList) -> None:
    for name, count in Counter(header).items():
        if count > 1 and name:
            faults.add(TelemetryFormatError, f"column {name[:MAX_NAME_LENGTH]}", f"stands {count} times in the header")
        if len(name) > MAX_NAME_LENGTH:
            faults.add(TelemetryFormatError, f"column {name[:20]}...", f"name longer than {MAX_NAME_LENGTH} characters")
        if any(unicodedata.category(character) in {"Cc", "Cs"} for character in name):
            faults.add(TelemetryFormatError, f"column {name!r}", "control character in the name")


def _check_missing(
    names: Mapping[str, str], times: TimeColumns, mapped: ColumnMap, header: Sequence[str], faults: FaultList
) -> None:
    present = {name for name in header if name}
    found = set(names.values())
    groups_begun = {name for group in GROUPS if found & set(group) for name in group}
    extra = [name for name in mapped if name not in STANDARD]
    near: dict[str, str] = {}
    missing = [own for own in times.own.values() if own not in present] if len(times.own) > 1 else []
    for own in missing:
        faults.add(TelemetryFormatError, f"column {own}", f"missing: the times are {times.words}")
    for name in (*STANDARD, *extra):
        own = times.own.get(TIME, TIME) if name == TIME else mapped.get(name, name)
        is_needed = name in (TIME, *READING) or name in mapped or name in groups_begun
        is_found = name in found if name in STANDARD else own in present
        if is_needed and not is_found:
            alias = "" if own == name else f" (mapped to {own!r})"
            close = suggested(name, own, header, names)
            near |= {} if close is None else {name: close}
            near |= date_beside(close, header) if name == TIME and close is not None else {}
            missing.append(own)
            faults.add(TelemetryFormatError, f"column {name}{alias}", f"missing{_hint(close, header)}")
    if missing and header:
        is_plain = all(own.isprintable() for own in near.values())
        told = f"the column map {json.dumps(near, ensure_ascii=not is_plain)}" if near else "the column map"
        faults.advise(f"name the columns of the table with {told} (--columns, or the columns of the magnetometer)")


def _hint(close: str | None, header: Sequence[str]) -> str:
    if close is not None:
        return f"; did you mean {quoted(close)}?"
    present = sorted({name for name in header if name})
    shown = ", ".join(present[:12])
    return f"; the table has: {shown}{', ...' if len(present) > 12 else ''}" if present else ""

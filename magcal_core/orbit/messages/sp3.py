"""Precise orbits in SP3, versions c and d (IGS): Earth-fixed positions of one satellite, with or without velocities."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Times
from magcal_core.errors import Fault, OrbitFormatError
from magcal_core.orbit.messages.epochs import to_utc
from magcal_core.orbit.messages.oem_text import Ephemeris

FIRST_LINE: Final = re.compile(r"#([a-z])([PV ])\d{4}")
READ_VERSIONS: Final = "cd"
_FRAMES: Final = ("IT", "IG", "WGS", "SLR", "UND", "NGS")
"""Beginnings of the names of coordinate systems that are Earth-fixed within a decimetre."""
_SYSTEMS: Final = {
    "GPS": ("GPS", 0), "GAL": ("GPS", 0), "QZS": ("GPS", 0), "IRN": ("GPS", 0), "BDT": ("GPS", 14), "TAI": ("TAI", 0),
    "UTC": ("UTC", 0), "GLO": ("UTC", 0),
}  # fmt: skip
"""Time system of the file -> the one that it runs with, and by how many seconds it is behind."""
_KM_S_PER_DM_S: Final = 1e-4
_DEGREE: Final = 9
_DEGREE_WITH_VELOCITIES: Final = 7


@dataclass(slots=True)
class _Content:
    system: str = ""
    frame: str = ""
    epochs: list[np.datetime64] = field(default_factory=list)
    positions: dict[str, list[tuple[int, list[float]]]] = field(default_factory=dict)
    velocities: dict[str, list[tuple[int, list[float]]]] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)


def parse_sp3(text: str) -> str:
    """Return the orbit in an SP3 file of one satellite as the text of an OEM.

    Raises
    ------
    OrbitFormatError
        The version, the coordinate or time system is not read, a line is malformed, or there are several satellites.
    """
    lines = text.removeprefix("\ufeff").splitlines()
    match = FIRST_LINE.match(lines[0])
    version = match[1] if match else "?"
    if version not in READ_VERSIONS:
        raise OrbitFormatError(f"this is an SP3 file of version {version}; c and d are read")
    content = _Content(frame=lines[0][46:51].strip())
    for number, line in enumerate(lines[1:], 2):
        _take(content, number, line)
    _check(content)
    return _ephemeris(content).text(f"an SP3 file of version {version}")


def _take(content: _Content, number: int, line: str) -> None:
    where = f"line {number}"
    if line.startswith("%c") and not content.system:
        content.system = line[9:12]
    elif line.startswith("*"):
        try:
            content.epochs.append(_epoch(line[1:].split()))
        except ValueError:
            content.faults.append(Fault(where, "want an epoch: * year month day hour minute second", line[:60]))
    elif line[:1] in "PV" and line:
        try:
            numbers = [float(line[at : at + 14]) for at in (4, 18, 32)]
        except ValueError:
            content.faults.append(Fault(where, "want three numbers of 14 columns", line[:60]))
            return
        if not content.epochs:
            content.faults.append(Fault(where, "stands before the first epoch"))
        elif any(numbers):
            kept = content.positions if line[0] == "P" else content.velocities
            kept.setdefault(line[1:4].strip(), []).append((len(content.epochs) - 1, numbers))


def _epoch(cells: list[str]) -> np.datetime64:
    year, month, day, hour, minute = (int(cell) for cell in cells[:5])
    whole, _, fraction = cells[5].partition(".")
    # A second of 60 is the first of the next minute.
    start = np.datetime64(datetime(year, month, day, hour, minute).isoformat(), "ns")  # noqa: DTZ001 - of its system
    ns = int(whole) * 10**9 + int((fraction + "0" * 9)[:9])
    return np.datetime64(start + np.timedelta64(ns, "ns"))


def _check(content: _Content) -> None:
    faults = content.faults
    if content.system not in _SYSTEMS:
        faults.append(Fault("%c", f"time system; want one of {', '.join(_SYSTEMS)}", content.system))
    if content.frame and not content.frame.upper().startswith(_FRAMES):
        faults.append(Fault("line 1", "coordinate system is not Earth-fixed; want ITRF, IGS or WGS84", content.frame))
    if not content.positions:
        faults.append(Fault("end", "there is no position"))
    if len(content.positions) > 1:
        names = ", ".join(list(content.positions)[:8])
        faults.append(Fault("line 3", f"{len(content.positions)} satellites ({names}); leave the one that it is"))
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"SP3, {faults[0].where}: {faults[0].why}{more}", faults)


def _ephemeris(content: _Content) -> Ephemeris:
    ((name, positions),) = content.positions.items()
    system, behind_s = _SYSTEMS[content.system]
    rows = [row for row, _ in positions]
    at: Times = np.asarray(np.array(content.epochs, "datetime64[ns]")[rows] + np.timedelta64(behind_s, "s"), "M8[ns]")
    speeds = dict(content.velocities.get(name, []))
    v_km_s: NDArray[np.float64] | None = None
    if all(row in speeds for row in rows):
        v_km_s = np.array([speeds[row] for row in rows]) * _KM_S_PER_DM_S
    method, degree = ("LAGRANGE", _DEGREE) if v_km_s is None else ("HERMITE", _DEGREE_WITH_VELOCITIES)
    r_km = np.array([numbers for _, numbers in positions])
    return Ephemeris(name, "", "ITRF", to_utc(at, system), r_km, v_km_s, method, degree)

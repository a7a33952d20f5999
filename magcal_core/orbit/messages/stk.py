"""Ephemerides of STK (``.e``): seconds from an epoch, positions and, mostly, velocities."""

from __future__ import annotations

from datetime import datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.errors import Fault, OrbitFormatError, TimeError
from magcal_core.orbit.messages.epochs import parse_epoch
from magcal_core.orbit.messages.kvn import number as _number
from magcal_core.orbit.messages.oem_text import Ephemeris

FRAME_OF_STK: Final = {
    "fixed": "ITRF", "itrf": "ITRF", "icrf": "GCRF", "gcrf": "GCRF", "j2000": "EME2000", "temeofdate": "TEME",
    "trueofdate": "TOD", "meanofdate": "MOD",
}  # fmt: skip
"""Coordinate systems that are read; those of another epoch than the date are not."""
_KM: Final = {"meters": 1e-3, "meter": 1e-3, "kilometers": 1.0, "kilometer": 1.0}
_TABLES: Final = {"ephemeristimeposvel": 7, "ephemeristimepos": 4, "ephemeristimeposvelacc": 10}
_MOST_DEGREE: Final = 31


def parse_stk(text: str) -> str:
    """Return the ephemeris in an STK file as the text of an OEM.

    Raises
    ------
    OrbitFormatError
        The file holds no ephemeris, is of another body, in a frame or unit that is not read, or a line is malformed.
    """
    said, rows = _parts(text)
    faults: list[Fault] = []
    if said.get("begin", "").lower() != "ephemeris":
        raise OrbitFormatError(f"this is an STK file of {said.get('begin', 'nothing')[:40]}; ephemerides (.e) are read")
    if said.get("centralbody", "Earth").lower() != "earth":
        faults.append(Fault("CentralBody", "want Earth", said["centralbody"]))
    frame = FRAME_OF_STK.get(said.get("coordinatesystem", "fixed").lower())
    if frame is None:
        known = "Fixed, ICRF, J2000, TEMEOfDate, TrueOfDate, MeanOfDate"
        faults.append(Fault("CoordinateSystem", f"want one of {known}", said["coordinatesystem"]))
    factor = _KM.get(said.get("distanceunit", "Meters").lower())
    if factor is None:
        faults.append(Fault("DistanceUnit", "want Meters or Kilometers", said["distanceunit"]))
    epoch = _epoch(said, faults)
    numbers = _numbers(rows, said.get("table", ""), faults)
    if faults or frame is None or factor is None or epoch is None:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"STK ephemeris, {faults[0].where}: {faults[0].why}{more}", faults)
    # At the boundary of two segments STK writes a state twice.
    numbers = numbers[np.r_[True, (np.diff(numbers[:, :4], axis=0) != 0.0).any(axis=1)]] if len(numbers) else numbers
    t_utc = epoch + np.rint(numbers[:, 0] * 1e9).astype("timedelta64[ns]")
    v_km_s = numbers[:, 4:7] * factor if numbers.shape[1] >= 7 else None
    method, degree = _method(said, v_km_s is not None)
    name = said.get("satellitename", "")
    ephemeris = Ephemeris(name, "", frame, t_utc, numbers[:, 1:4] * factor, v_km_s, method, degree)
    return ephemeris.text("an STK ephemeris")


def _parts(text: str) -> tuple[dict[str, str], list[tuple[int, list[str]]]]:
    """Return what is said by keyword, lower case, and the rows of the table with their numbers of line."""
    said: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, raw in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
        cells = raw.split("#")[0].split()
        if not cells or cells[0].lower().startswith("stk.v"):
            continue
        keyword, value = cells[0].lower(), " ".join(cells[1:])
        if keyword in _TABLES:
            said["table"] = keyword
        elif "table" in said and (cells[0][0].isdigit() or cells[0][0] in "+-."):
            rows.append((number, cells))
        elif keyword == "end" and value.lower() in ("", "ephemeris"):
            break
        else:
            said.setdefault(keyword, value)
    return said, rows


def _epoch(said: dict[str, str], faults: list[Fault]) -> np.datetime64 | None:
    text = said.get("scenarioepoch", "")
    whole, _, fraction = text.removesuffix("Z").removesuffix("UTCG").strip().partition(".")
    for pattern in ("%d %b %Y %H:%M:%S", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%d %H:%M:%S"):
        try:
            moment = datetime.strptime(whole[:40], pattern)  # noqa: DTZ007 - UTC, as STK has it
        except ValueError:
            continue
        if fraction and not fraction.isdecimal():
            break
        return np.datetime64(moment, "ns") + np.timedelta64(int((fraction + "0" * 9)[:9]), "ns")
    try:
        return parse_epoch(text)
    except TimeError:
        faults.append(Fault("ScenarioEpoch", "want a time such as 19 Feb 2022 22:37:44.000", text[:40]))
        return None


def _numbers(rows: list[tuple[int, list[str]]], table: str, faults: list[Fault]) -> NDArray[np.float64]:
    width = _TABLES.get(table, 0)
    if not width:
        faults.append(Fault("end", "there is no table EphemerisTimePosVel or EphemerisTimePos"))
    values: list[list[float]] = []
    for number, cells in rows:
        try:
            found = [_number(cell) for cell in cells]
        except ValueError:
            found = []
        if len(found) != width or not np.isfinite(found).all():
            faults.append(Fault(f"line {number}", f"want {width} numbers", " ".join(cells)[:60]))
        else:
            values.append(found)
    return np.array(values).reshape(len(values), width)


def _method(said: dict[str, str], has_velocities: bool) -> tuple[str, int]:
    """Return how the file says that it is interpolated; Lagrange of degree 5 where it does not."""
    text = said.get("interpolationorder") or said.get("interpolationsamplesm1") or "5"
    degree = min(int(text), _MOST_DEGREE) if text.isdecimal() and int(text) else 5
    if said.get("interpolationmethod", "Lagrange").lower() == "hermite" and has_velocities:
        return "HERMITE", degree
    return "LAGRANGE", degree

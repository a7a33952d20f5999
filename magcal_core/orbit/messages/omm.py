"""Orbit Mean-elements Messages of CCSDS in JSON, XML, CSV and KVN: what a TLE says, without its columns."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from sgp4.api import WGS72, Satrec

from magcal_core.errors import Fault, OrbitFormatError, TimeError
from magcal_core.orbit.messages.epochs import parse_epoch
from magcal_core.orbit.messages.kvn import find_all, kvn_lines, leaves, number, parse_xml
from magcal_core.orbit.messages.tle import EARTH_RADIUS_SGP4_KM, apsides_km

MAX_MESSAGES: Final = 100_000

_EPOCH_OF_SGP4: Final = np.datetime64("1949-12-31", "ns")
_MINUTES_PER_DAY: Final = 1440.0
_LARGEST_SATNUM: Final = 339_999

_NUMBERS: Final[Mapping[str, tuple[float, float]]] = {
    "MEAN_MOTION": (1e-3, 20.0),
    "ECCENTRICITY": (0.0, 1.0 - 1e-9),
    "INCLINATION": (0.0, 180.0),
    "RA_OF_ASC_NODE": (-360.0, 360.0),
    "ARG_OF_PERICENTER": (-360.0, 360.0),
    "MEAN_ANOMALY": (-360.0, 360.0),
}
_OPTIONAL: Final[Mapping[str, tuple[float, float]]] = {
    "BSTAR": (-10.0, 10.0),
    "MEAN_MOTION_DOT": (-1e3, 1e3),
    "MEAN_MOTION_DDOT": (-1e3, 1e3),
    "EPHEMERIS_TYPE": (0, 9),
}
_CATALOGUE: Final = re.compile(r"\+?0*\d{1,9}", re.ASCII)
_FIXED: Final[Mapping[str, tuple[str, ...]]] = {
    "CENTER_NAME": ("EARTH",),
    "REF_FRAME": ("TEME",),
    "TIME_SYSTEM": ("UTC",),
    "MEAN_ELEMENT_THEORY": ("SGP4", "SGP/SGP4", "SGP"),
    "EPHEMERIS_TYPE": ("0", "2", "3"),
}
_COSPAR: Final = re.compile(r"\d{4}-\d{3}[A-Z]{1,3}")


@dataclass(frozen=True, slots=True)
class Omm:
    """Mean elements of SGP4 from a message whose every value has been verified; angles in deg, motion in rev/day."""

    name: str
    norad_id: str
    cospar_id: str
    epoch_utc: np.datetime64
    mean_motion_rev_day: float
    eccentricity: float
    inclination_deg: float
    raan_deg: float
    argument_of_perigee_deg: float
    mean_anomaly_deg: float
    bstar: float
    mean_motion_dot: float
    mean_motion_ddot: float
    perigee_km: float
    apogee_km: float

    @property
    def text(self) -> str:
        """The message as JSON, as `parse_omms` reads it."""
        record = {
            "OBJECT_NAME": self.name,
            "OBJECT_ID": self.cospar_id,
            "NORAD_CAT_ID": self.norad_id,
            "EPOCH": np.datetime_as_string(self.epoch_utc, unit="ns"),
            "MEAN_MOTION": self.mean_motion_rev_day,
            "ECCENTRICITY": self.eccentricity,
            "INCLINATION": self.inclination_deg,
            "RA_OF_ASC_NODE": self.raan_deg,
            "ARG_OF_PERICENTER": self.argument_of_perigee_deg,
            "MEAN_ANOMALY": self.mean_anomaly_deg,
            "BSTAR": self.bstar,
            "MEAN_MOTION_DOT": self.mean_motion_dot,
            "MEAN_MOTION_DDOT": self.mean_motion_ddot,
        }
        return json.dumps(record)

    def satrec(self) -> Satrec:
        """Return the elements as `sgp4` wants them."""
        satrec = Satrec()
        number = int(self.norad_id or 0)
        satrec.sgp4init(
            WGS72,
            "i",
            number if number <= _LARGEST_SATNUM else 0,
            float((self.epoch_utc - _EPOCH_OF_SGP4).astype(np.int64)) / 86400e9,
            self.bstar,
            self.mean_motion_dot * 2.0 * math.pi / _MINUTES_PER_DAY**2,
            self.mean_motion_ddot * 2.0 * math.pi / _MINUTES_PER_DAY**3,
            self.eccentricity,
            math.radians(self.argument_of_perigee_deg),
            math.radians(self.inclination_deg),
            math.radians(self.mean_anomaly_deg),
            self.mean_motion_rev_day * 2.0 * math.pi / _MINUTES_PER_DAY,
            math.radians(self.raan_deg),
        )
        return satrec


def parse_omms(text: str, form: str) -> list[Omm]:
    """Return every message of a text whose form is ``json``, ``xml``, ``csv`` or ``kvn``.

    Raises
    ------
    OrbitFormatError
        The text is not of that form, has no message, or a message has a value that it cannot have; ``faults`` has each.
    """
    records = _READERS[form](text)
    if not records:
        raise OrbitFormatError("there is no OMM in the text")
    if len(records) > MAX_MESSAGES:
        raise OrbitFormatError(f"there are {len(records)} OMMs in the text; at most {MAX_MESSAGES}")
    faults: list[Fault] = []
    messages = [_omm(record, f"message {i}", faults) for i, record in enumerate(records, 1)]
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"OMM, {faults[0].where}: {faults[0].why}{more}", faults)
    return [message for message in messages if message is not None]


def _from_json(text: str) -> Sequence[Mapping[str, str]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise OrbitFormatError("the OMM is not JSON", [Fault("OMM", str(error)[:200])]) from error
    rows = content if isinstance(content, list) else [content]
    if not all(isinstance(row, dict) for row in rows):
        raise OrbitFormatError("OMM in JSON is an object or a list of objects")
    return [{key.upper(): "" if value is None else str(value) for key, value in row.items()} for row in rows]


def _from_xml(text: str) -> Sequence[Mapping[str, str]]:
    return [leaves(message) for message in find_all(parse_xml(text), "omm")]


def _from_csv(text: str) -> Sequence[Mapping[str, str]]:
    header = text.partition("\n")[0]
    separator = max(",;\t", key=header.count)
    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True, delimiter=separator)
    width = len(rows.fieldnames or ())
    records: list[Mapping[str, str]] = []
    faults: list[Fault] = []
    try:
        for row in rows:
            given = {
                key.strip().upper(): value for key, value in row.items() if isinstance(key, str) and value is not None
            }
            if len(given) < width or None in row:
                cells = len(given) + len(row.get(None) or ())
                faults.append(Fault(f"line {rows.line_num}", f"{cells} cells, the header has {width}"))
            records.append(given)
    except csv.Error as error:
        raise OrbitFormatError("the OMM is not CSV", [Fault(f"line {rows.line_num}", str(error))]) from error
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"OMM in CSV, {faults[0].where}: {faults[0].why}{more}", faults)
    return records


def _from_kvn(text: str) -> Sequence[Mapping[str, str]]:
    messages: list[dict[str, str]] = []
    for line in kvn_lines(text):
        if line.keyword == "CCSDS_OMM_VERS":
            messages.append({})
        elif not line.keyword or not messages:
            why = "want KEYWORD = value after CCSDS_OMM_VERS"
            raise OrbitFormatError(f"OMM, line {line.number}: {why}", [Fault(f"line {line.number}", why)])
        else:
            messages[-1][line.keyword] = line.value
    return messages


_READERS: Final[Mapping[str, Callable[[str], Sequence[Mapping[str, str]]]]] = {
    "json": _from_json,
    "xml": _from_xml,
    "csv": _from_csv,
    "kvn": _from_kvn,
}


def _omm(record: Mapping[str, str], where: str, faults: list[Fault]) -> Omm | None:
    before = len(faults)
    for key, known in _FIXED.items():
        value = record.get(key, "").strip().upper()
        value = value.lstrip("+") if key == "EPHEMERIS_TYPE" else value
        if value and value not in known:
            faults.append(Fault(f"{where}, {key}", f"want {' or '.join(known)}", record[key]))
    values = {key: _number(record, key, limits, where, faults) for key, limits in _NUMBERS.items()}
    for key, limits in _OPTIONAL.items():
        values[key] = _number(record, key, limits, where, faults) if record.get(key, "").strip() else 0.0
    norad_id = record.get("NORAD_CAT_ID", "").strip()
    if norad_id and not _CATALOGUE.fullmatch(norad_id):
        faults.append(Fault(f"{where}, NORAD_CAT_ID", "want an integer of at most nine digits", norad_id[:40]))
    epoch = _epoch(record, where, faults)
    if len(faults) > before or epoch is None:
        return None
    motion, eccentricity, inclination = values["MEAN_MOTION"], values["ECCENTRICITY"], values["INCLINATION"]
    perigee_km, apogee_km = apsides_km(motion, eccentricity, inclination)
    if perigee_km < EARTH_RADIUS_SGP4_KM:
        under_km = EARTH_RADIUS_SGP4_KM - perigee_km
        faults.append(Fault(f"{where}, MEAN_MOTION", f"puts the perigee {under_km:.0f} km below the ground"))
        return None
    cospar = record.get("OBJECT_ID", "").strip()
    return Omm(
        name=record.get("OBJECT_NAME", "").strip()[:100],
        norad_id=str(int(norad_id)) if norad_id else "",
        cospar_id=cospar if _COSPAR.fullmatch(cospar) else "",
        epoch_utc=epoch,
        mean_motion_rev_day=motion,
        eccentricity=eccentricity,
        inclination_deg=inclination,
        raan_deg=values["RA_OF_ASC_NODE"],
        argument_of_perigee_deg=values["ARG_OF_PERICENTER"],
        mean_anomaly_deg=values["MEAN_ANOMALY"],
        bstar=values["BSTAR"],
        mean_motion_dot=values["MEAN_MOTION_DOT"],
        mean_motion_ddot=values["MEAN_MOTION_DDOT"],
        perigee_km=perigee_km,
        apogee_km=apogee_km,
    )


def _number(record: Mapping[str, str], key: str, limits: tuple[float, float], where: str, faults: list[Fault]) -> float:
    text = record.get(key, "").strip()
    try:
        value = number(text)
    except ValueError:
        faults.append(Fault(f"{where}, {key}", "is not a number" if text else "is missing", text[:40]))
        return math.nan
    if not limits[0] <= value <= limits[1]:
        faults.append(Fault(f"{where}, {key}", f"is {value}; want {limits[0]:g} to {limits[1]:g}"))
    return value


def _epoch(record: Mapping[str, str], where: str, faults: list[Fault]) -> np.datetime64 | None:
    text = record.get("EPOCH", "")
    try:
        return parse_epoch(text)
    except TimeError as error:
        faults.append(Fault(f"{where}, EPOCH", error.message if text.strip() else "is missing"))
        return None

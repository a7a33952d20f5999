"""Orbit Parameter Messages of CCSDS, KVN and XML: one state vector."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from magcal_core.errors import Fault, OrbitFormatError, TimeError
from magcal_core.orbit.earth.frames import FRAMES, Frame
from magcal_core.orbit.messages.elements import elements_from_state
from magcal_core.orbit.messages.epochs import TIME_SYSTEMS, parse_epoch, to_utc
from magcal_core.orbit.messages.frames_of_date import in_known_frame, is_known, known_frames
from magcal_core.orbit.messages.kvn import find_all, kvn_lines, leaves, number, parse_xml
from magcal_core.orbit.messages.state import StateVector

_STATE: Final = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
_KEYS: Final = ("REF_FRAME", "TIME_SYSTEM", "EPOCH", *_STATE)
_RADIUS_KM: Final = (6300.0, 1e6)


def parse_opms(text: str) -> list[tuple[StateVector, str, str]]:
    """Return the state vector of every OPM in a text, with the name and the COSPAR id of its object.

    Raises
    ------
    OrbitFormatError
        A message is malformed, has manoeuvres, is of another body, or in a frame or time system that is not read;
        ``faults`` has each.
    """
    is_xml = text.lstrip("\ufeff \r\n\t").startswith("<")
    records = [leaves(one) for one in find_all(parse_xml(text), "opm")] if is_xml else _from_kvn(text)
    faults: list[Fault] = []
    found = [_opm(record, f"message {i}", faults) for i, record in enumerate(records, 1)]
    if not records:
        raise OrbitFormatError("there is no OPM in the text")
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"OPM, {faults[0].where}: {faults[0].why}{more}", faults)
    return [one for one in found if one is not None]


def _from_kvn(text: str) -> list[dict[str, str]]:
    records: list[dict[str, str]] = []
    for line in kvn_lines(text):
        if line.keyword == "CCSDS_OPM_VERS":
            records.append({})
        elif not line.keyword or not records:
            raise OrbitFormatError(f"OPM, line {line.number}: want KEYWORD = value after CCSDS_OPM_VERS")
        else:
            records[-1].setdefault(line.keyword, line.value)
    return records


def _opm(record: Mapping[str, str], where: str, faults: list[Fault]) -> tuple[StateVector, str, str] | None:
    before = len(faults)
    faults.extend(Fault(f"{where}, {key}", "is missing") for key in _KEYS if not record.get(key, "").strip())
    if any(key.startswith("MAN_") and value for key, value in record.items()):
        faults.append(Fault(f"{where}, MAN_EPOCH_IGNITION", "manoeuvres are not integrated; send a state after them"))
    if record.get("CENTER_NAME", "EARTH").strip().upper() != "EARTH":
        faults.append(Fault(f"{where}, CENTER_NAME", "want EARTH", record["CENTER_NAME"]))
    name = record.get("REF_FRAME", "").strip()
    if name and not is_known(name):
        faults.append(Fault(f"{where}, REF_FRAME", f"want one of {', '.join(known_frames())}", name))
    system = record.get("TIME_SYSTEM", "UTC").strip().upper()
    if system not in TIME_SYSTEMS:
        faults.append(Fault(f"{where}, TIME_SYSTEM", f"want one of {', '.join(TIME_SYSTEMS)}", system))
    if len(faults) > before:
        return None
    try:
        epoch = to_utc(np.array([parse_epoch(record["EPOCH"])]), system)
        numbers = np.array([number(record[key]) for key in _STATE])
    except (TimeError, ValueError) as error:
        faults.append(Fault(where, f"want an epoch and six numbers: {error}"))
        return None
    radius_km = float(np.linalg.norm(numbers[:3]))
    if not np.isfinite(numbers).all() or not _RADIUS_KM[0] <= radius_km <= _RADIUS_KM[1]:
        faults.append(Fault(where, f"is {radius_km:.6g} km from the Earth's centre; want 6300 to 1000000 km"))
        return None
    frame, r_km, v_km_s = in_known_frame(name, epoch, numbers[None, :3], numbers[None, 3:])
    known: Frame = next(one for one in FRAMES if one == frame)
    state = StateVector(epoch[0], known, r_km[0], v_km_s[0])
    if known != "ITRF":
        elements_from_state(state.r_km, state.v_km_s)
    return state, record.get("OBJECT_NAME", "").strip()[:100], record.get("OBJECT_ID", "").strip()[:100]

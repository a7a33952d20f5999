"""State vectors as orbit input: one epoch, one frame, one position, one velocity."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.errors import Fault, OrbitFormatError, TimeError
from magcal_core.orbit.earth.frames import FRAMES, Frame, State, convert_state
from magcal_core.orbit.messages.elements import OsculatingElements, elements_from_state
from magcal_core.orbit.messages.epochs import parse_epoch

_KEYS: Final = ("epoch", "frame", "position_km", "velocity_km_s")
_RADIUS_KM: Final = (6300.0, 1e6)
"""From below the ground to outside the Earth's reach: what lies outside is a wrong unit."""


@dataclass(frozen=True, slots=True, eq=False)
class StateVector:
    """Position, km, and velocity, km/s, each of shape (3,), at an epoch in a frame; inertial but for ITRF."""

    epoch_utc: np.datetime64
    frame: Frame
    r_km: Floats
    v_km_s: Floats

    @property
    def text(self) -> str:
        """The state as JSON, as `parse_state` reads it."""
        record = {
            "epoch": f"{np.datetime_as_string(self.epoch_utc, unit='ns')}Z",
            "frame": self.frame,
            "position_km": self.r_km.tolist(),
            "velocity_km_s": self.v_km_s.tolist(),
        }
        return json.dumps(record)

    def in_frame(self, frame: Frame) -> StateVector:
        """Return the same state in another frame."""
        t_utc = np.array([self.epoch_utc], "datetime64[ns]")
        state: State = convert_state(t_utc, self.r_km[None], self.v_km_s[None], self.frame, frame)
        return StateVector(self.epoch_utc, frame, state[0][0], state[1][0])

    def elements(self, frame: Frame = "GCRF") -> OsculatingElements:
        """Return the osculating elements in an inertial frame."""
        state = self.in_frame(frame)
        return elements_from_state(state.r_km, state.v_km_s)


def parse_state(text: str) -> StateVector:
    """Return the state vector in JSON ``{"epoch", "frame", "position_km", "velocity_km_s"}``.

    Raises
    ------
    OrbitFormatError
        The text is not such an object; ``faults`` has everything that is wrong.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise OrbitFormatError("the state vector is not JSON", [Fault("state", str(error)[:200])]) from error
    if not isinstance(content, dict):
        raise OrbitFormatError("the state vector is not a JSON object")
    return state_from_mapping(content)


def state_from_mapping(content: Mapping[str, object]) -> StateVector:
    """Return the state vector in a mapping with the keys of the JSON form.

    Raises
    ------
    OrbitFormatError
        A key is missing, unknown, or has a value that it cannot have; ``faults`` has each.
    """
    faults = [Fault(key, "is missing") for key in _KEYS if key not in content]
    faults += [Fault(key, f"unknown; a state vector has {', '.join(_KEYS)}") for key in content if key not in _KEYS]
    epoch = _epoch(content.get("epoch"), faults) if "epoch" in content else None
    frame = next((f for f in FRAMES if f == content.get("frame")), None)
    if "frame" in content and frame is None:
        faults.append(Fault("frame", f"unknown; known are {', '.join(FRAMES)}"))
    position = _triple(content, "position_km", faults)
    velocity = _triple(content, "velocity_km_s", faults)
    if position is not None and not _RADIUS_KM[0] <= (radius_km := math.hypot(*position)) <= _RADIUS_KM[1]:
        limits = f"{_RADIUS_KM[0]:.0f} to {_RADIUS_KM[1]:.0f} km"
        faults.append(Fault("position_km", f"is {radius_km:.6g} km from the Earth's centre; want {limits}"))
    if faults or epoch is None or frame is None or position is None or velocity is None:
        raise OrbitFormatError(f"state vector: {faults[0].where} {faults[0].why}", faults)
    state = StateVector(epoch, frame, np.array(position), np.array(velocity))
    if frame != "ITRF":
        elements_from_state(state.r_km, state.v_km_s)
    return state


def _epoch(value: object, faults: list[Fault]) -> np.datetime64 | None:
    if not isinstance(value, str):
        faults.append(Fault("epoch", "is not text such as 2022-02-19T22:37:44.130Z"))
        return None
    try:
        return parse_epoch(value, needs_zone=True)
    except TimeError as error:
        faults.append(Fault("epoch", error.message))
        return None


def _triple(content: Mapping[str, object], key: str, faults: list[Fault]) -> list[float] | None:
    value = content.get(key)
    if isinstance(value, list) and len(value) == 3 and all(_is_number(part) for part in value):
        return [float(part) for part in value]
    if key in content:
        faults.append(Fault(key, "is not three finite numbers"))
    return None


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e100

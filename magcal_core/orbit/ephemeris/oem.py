"""Orbit Ephemeris Messages of CCSDS, KVN and XML: positions at nodes, interpolated as the message says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats, Times
from magcal_core.errors import Fault, ModelRangeError, OrbitFormatError, TimeError
from magcal_core.numerics.interpolation import StateTable
from magcal_core.orbit.earth.frames import Frame, State, convert_position, convert_state
from magcal_core.orbit.earth.timescales import nanoseconds
from magcal_core.orbit.ephemeris.interpolation_check import REFUSED_KM, Interpolation, best_interpolation
from magcal_core.orbit.messages.epochs import TIME_SYSTEMS, parse_epoch, to_utc
from magcal_core.orbit.messages.frames_of_date import in_known_frame, is_known, known_frames
from magcal_core.orbit.messages.kvn import KvnLine, find_all, kvn_lines, leaves, number, parse_xml

MAX_STATES: Final = 500_000
DEFAULT_DEGREE: Final = 7
"""Of the polynomial where a message does not say."""

_KEYS: Final = ("REF_FRAME", "TIME_SYSTEM", "START_TIME", "STOP_TIME")
_MAX_DEGREE: Final = 31


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """One stretch of an ephemeris: nodes in one frame, the times at which it may be used, how it is interpolated.

    ``checked`` says how far interpolation is off; None where that was not looked at.
    """

    frame: Frame
    table: StateTable
    start_ns: int
    stop_ns: int
    interpolation: str
    degree: int
    checked: Interpolation | None = None

    def state(self, stamps_ns: NDArray[np.int64]) -> State:
        """Return position, km, and velocity, km/s, each of shape (n, 3), in the segment's frame."""
        if self.interpolation == "HERMITE":
            return self.table.hermite(stamps_ns, self.degree)
        return self.table.lagrange(stamps_ns, self.degree)


@dataclass(frozen=True, slots=True, eq=False)
class OemOrbit:
    """An ephemeris; it gives no position outside its segments."""

    segments: tuple[Segment, ...]
    name: str = ""
    cospar_id: str = ""
    text: str = field(default="", repr=False)
    model: str = field(default="oem", init=False)

    @classmethod
    def from_text(cls, text: str) -> OemOrbit:
        """Return the ephemeris in an OEM, KVN or XML; see `parse_oem` for what it raises."""
        return parse_oem(text)

    @property
    def epoch_utc(self) -> np.datetime64:
        """Start of the ephemeris, UTC."""
        return np.datetime64(min(segment.start_ns for segment in self.segments), "ns")

    @property
    def until_utc(self) -> np.datetime64:
        """End of the ephemeris, UTC."""
        return np.datetime64(max(segment.stop_ns for segment in self.segments), "ns")

    def covers(self, t_utc: Times) -> NDArray[np.bool_]:
        """Return at which times the position is known, shape (n,)."""
        return self._segment_of(nanoseconds(t_utc)) >= 0

    def position_itrf_km(self, t_utc: Times) -> Floats:
        """Return the position at ``t_utc``, shape (n, 3), ITRF, km.

        Raises
        ------
        ModelRangeError
            A time is outside the segments.
        """
        r_itrf_km = np.empty((np.size(t_utc), 3))
        for segment, rows in self._split(t_utc):
            r_km, _ = segment.state(nanoseconds(t_utc[rows]))
            r_itrf_km[rows] = convert_position(t_utc[rows], r_km, segment.frame, "ITRF")
        return r_itrf_km

    def state_gcrf(self, t_utc: Times) -> State:
        """Return position, km, and velocity, km/s, at ``t_utc``, each of shape (n, 3), GCRF.

        Raises
        ------
        ModelRangeError
            A time is outside the segments.
        """
        r_gcrf_km, v_gcrf_km_s = np.empty((np.size(t_utc), 3)), np.empty((np.size(t_utc), 3))
        for segment, rows in self._split(t_utc):
            state = segment.state(nanoseconds(t_utc[rows]))
            r_gcrf_km[rows], v_gcrf_km_s[rows] = convert_state(t_utc[rows], *state, segment.frame, "GCRF")
        return r_gcrf_km, v_gcrf_km_s

    def interpolation_error_km(self, t_utc: Times) -> Floats:
        """Return how far interpolation between the points is off at the most about each time, km, shape (n,).

        0 outside the segments.
        """
        stamps = nanoseconds(t_utc)
        errors_km = np.zeros(len(stamps))
        for checked, rows in self._checked(stamps):
            errors_km[rows] = checked.error_km(stamps[rows])
        return errors_km

    def is_astray(self, t_utc: Times) -> NDArray[np.bool_]:
        """Return whether the points about each time are not those of an orbit under known forces, shape (n,).

        A manoeuvre, for one; the error between such points is from points left out, and can be wrong by a factor.
        """
        stamps = nanoseconds(t_utc)
        is_astray = np.zeros(len(stamps), np.bool_)
        for checked, rows in self._checked(stamps):
            is_astray[rows] = checked.is_astray(stamps[rows])
        return is_astray

    def _checked(self, stamps_ns: NDArray[np.int64]) -> Iterator[tuple[Interpolation, NDArray[np.bool_]]]:
        """Yield what was found about each segment that was looked at, and which times are in it."""
        index = self._segment_of(stamps_ns)
        for i, segment in enumerate(self.segments):
            if segment.checked is not None:
                yield segment.checked, index == i

    def _segment_of(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        index = np.full(len(stamps_ns), -1, np.intp)
        for i, segment in enumerate(self.segments):
            index[(stamps_ns >= segment.start_ns) & (stamps_ns <= segment.stop_ns)] = i
        return index

    def _split(self, t_utc: Times) -> list[tuple[Segment, NDArray[np.intp]]]:
        index = self._segment_of(nanoseconds(t_utc))
        if index.size and index.min() < 0:
            when = np.datetime_as_string(t_utc[int(np.argmin(index))], unit="ms")
            first, last = (np.datetime_as_string(t, unit="ms") for t in (self.epoch_utc, self.until_utc))
            raise ModelRangeError(f"the ephemeris has no position at {when}Z: it has {first}Z to {last}Z")
        used = np.unique(index)
        return [(self.segments[i], np.flatnonzero(index == i)) for i in used]


def parse_oem(text: str) -> OemOrbit:
    """Return the ephemeris in an OEM, KVN or XML.

    Raises
    ------
    OrbitFormatError
        The message is malformed, of another body, or in a frame or time system that cannot be converted; ``faults``
        has each.
    """
    faults: list[Fault] = []
    parts = _xml_segments(text, faults) if text.lstrip("\ufeff \r\n\t").startswith("<") else _kvn_segments(text, faults)
    if not parts and not faults:
        raise OrbitFormatError("there is no segment in the OEM")
    # Some producers begin each day with a segment, also where they have nothing for it, or write a state twice.
    parts = [(meta, _without_repeats(rows)) for meta, rows in parts if rows] or parts
    segments = [_segment(meta, rows, f"segment {i}", faults) for i, (meta, rows) in enumerate(parts, 1)]
    if faults:
        more = f" and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise OrbitFormatError(f"OEM, {faults[0].where}: {faults[0].why}{more}", faults)
    name, cospar_id = (parts[0][0].get(key, "")[:100] for key in ("OBJECT_NAME", "OBJECT_ID"))
    return OemOrbit(tuple(segment for segment in segments if segment is not None), name, cospar_id, text)


Row = tuple[str, Sequence[str]]
"""Where a state stands in the text, and its cells: epoch, position, velocity."""
Part = tuple[Mapping[str, str], Sequence[Row]]


def _kvn_segments(text: str, faults: list[Fault]) -> list[Part]:
    parts: list[tuple[dict[str, str], list[Row]]] = []
    where = "header"
    for line in kvn_lines(text):
        where = _next_place(line, where)
        if line.value == "META_START":
            parts.append(({}, []))
        elif where == "meta" and line.keyword:
            parts[-1][0][line.keyword] = line.value
        elif where == "states" and not line.keyword and line.value not in ("META_STOP", "COVARIANCE_STOP"):
            parts[-1][1].append((f"line {line.number}", line.value.split()))
        elif where in ("header", "meta") and not line.keyword:
            stop = "META_START" if where == "header" else "META_STOP"
            faults.append(Fault(f"line {line.number}", f"want {stop} or KEYWORD = value"))
    if where == "meta":
        faults.append(Fault("end", "META_STOP is missing: the message is cut"))
    return list(parts)


def _without_repeats(rows: Sequence[Row]) -> Sequence[Row]:
    return [row for i, row in enumerate(rows) if not i or row[1] != rows[i - 1][1]]


def _next_place(line: KvnLine, where: str) -> str:
    after = {"META_START": "meta", "META_STOP": "states", "COVARIANCE_START": "covariance", "COVARIANCE_STOP": "states"}
    return where if line.keyword else after.get(line.value, where)


def _xml_segments(text: str, faults: list[Fault]) -> list[Part]:
    parts: list[Part] = []
    for segment in find_all(parse_xml(text), "segment"):
        meta = {key: value for block in find_all(segment, "metadata") for key, value in leaves(block).items()}
        rows: list[Row] = []
        for i, vector in enumerate(find_all(segment, "stateVector"), 1):
            cells = leaves(vector)
            names = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
            if missing := [name for name in names if name not in cells]:
                faults.append(Fault(f"segment {len(parts) + 1}, state {i}", f"{missing[0]} is missing"))
            else:
                rows.append((f"segment {len(parts) + 1}, state {i}", [cells[name] for name in names]))
        parts.append((meta, rows))
    return parts


def _segment(meta: Mapping[str, str], rows: Sequence[Row], where: str, faults: list[Fault]) -> Segment | None:
    before = len(faults)
    faults.extend(Fault(f"{where}, {key}", "is missing") for key in _KEYS if not meta.get(key))
    name = meta.get("REF_FRAME", "")
    if name and not is_known(name):
        faults.append(Fault(f"{where}, REF_FRAME", f"want one of {', '.join(known_frames())}", meta["REF_FRAME"]))
    if meta.get("CENTER_NAME", "EARTH").upper() != "EARTH":
        faults.append(Fault(f"{where}, CENTER_NAME", "want EARTH", meta["CENTER_NAME"]))
    system = meta.get("TIME_SYSTEM", "UTC").upper()
    if system not in TIME_SYSTEMS:
        faults.append(Fault(f"{where}, TIME_SYSTEM", f"want one of {', '.join(TIME_SYSTEMS)}", system))
    states = _states(rows, faults)
    if len(faults) > before:
        return None
    epochs, numbers = states
    t_utc = to_utc(epochs, system)
    frame, r_km, v_km_s = in_known_frame(name, t_utc, numbers[:, :3].copy(), numbers[:, 3:6].copy())
    table = StateTable(nanoseconds(t_utc), r_km, v_km_s)
    method, degree = _method(meta, len(rows), where, faults)
    span = _span(meta, system, table, where, faults)
    if len(faults) > before:
        return None
    found = best_interpolation(table, method, degree, frame)
    if found.typical_km > REFUSED_KM:
        step_s = float(np.median(np.diff(table.stamps_ns))) / 1e9
        why = (
            f"interpolation ({method} {degree}) between its points, {step_s:g} s apart, is {found.typical_km:.2g} km "
            f"off; limit {REFUSED_KM:g} km: send points closer together, or velocities that are those of the positions"
        )
        faults.append(Fault(where, why))
        return None
    return Segment(frame, table, *span, found.method, found.degree, found)


def _states(rows: Sequence[Row], faults: list[Fault]) -> tuple[Times, Floats]:
    if len(rows) > MAX_STATES:
        faults.append(Fault("states", f"{len(rows)} states; at most {MAX_STATES}"))
        return np.zeros(0, "datetime64[ns]"), np.zeros((0, 6))
    epochs = np.zeros(len(rows), "datetime64[ns]")
    numbers = np.full((len(rows), 6), np.nan)
    for i, (place, cells) in enumerate(rows):
        try:
            epochs[i] = parse_epoch(cells[0])
            numbers[i] = [number(cell) for cell in cells[1:7]]
        except TimeError as error:
            faults.append(Fault(place, error.message))
        except ValueError:
            faults.append(Fault(place, "want an epoch, a position and a velocity of three numbers each"))
        else:
            radius_km = float(np.linalg.norm(numbers[i, :3]))
            if not np.isfinite(numbers[i]).all() or not 6300.0 <= radius_km <= 1e6:
                faults.append(Fault(place, f"is {radius_km:.6g} km from the Earth's centre; want 6300 to 1000000 km"))
            elif i and epochs[i] <= epochs[i - 1]:
                faults.append(Fault(place, "epoch is not after the one before"))
    return epochs, numbers


def _method(meta: Mapping[str, str], states: int, where: str, faults: list[Fault]) -> tuple[str, int]:
    method = meta.get("INTERPOLATION", "").upper()
    if method not in ("", "LAGRANGE", "HERMITE", "LINEAR"):
        faults.append(Fault(f"{where}, INTERPOLATION", "want LAGRANGE, HERMITE or LINEAR", method))
        return "", 0
    if not method:
        method, degree = "HERMITE", min(DEFAULT_DEGREE, 2 * states - 1)
    elif method == "LINEAR":
        method, degree = "LAGRANGE", 1
    else:
        text = meta.get("INTERPOLATION_DEGREE", "")
        if not text:
            return method, min(DEFAULT_DEGREE, (2 * states if method == "HERMITE" else states) - 1)
        if not text.isdecimal() or not 1 <= int(text) <= _MAX_DEGREE:
            faults.append(Fault(f"{where}, INTERPOLATION_DEGREE", f"want 1 to {_MAX_DEGREE}", text))
            return method, 0
        degree = int(text)
    needed = max(2, (degree + 2) // 2 if method == "HERMITE" else degree + 1)
    if states < needed:
        faults.append(Fault(where, f"{states} states; interpolation of degree {degree} needs {needed}"))
    return method, degree


def _span(meta: Mapping[str, str], system: str, table: StateTable, where: str, faults: list[Fault]) -> tuple[int, int]:
    ends = []
    for useable, full in (("USEABLE_START_TIME", "START_TIME"), ("USEABLE_STOP_TIME", "STOP_TIME")):
        key = useable if meta.get(useable) else full
        try:
            end = to_utc(np.array([parse_epoch(meta[key])]), system)
            ends.append(int(nanoseconds(end)[0]))
        except TimeError as error:
            faults.append(Fault(f"{where}, {key}", error.message))
            return 0, 0
    if ends[0] > ends[1]:
        faults.append(Fault(f"{where}, USEABLE_STOP_TIME", "is before the start"))
    if len(table.stamps_ns):
        ends = [max(ends[0], int(table.stamps_ns[0])), min(ends[1], int(table.stamps_ns[-1]))]
    return ends[0], ends[1]

"""Frames that messages name: those of `magcal_core.orbit.earth.frames`, and frames of date, which are turned into them.

Notes
-----
True of date (TOD) and mean of date (MOD) are turned to GCRF with the IAU 2006/2000A matrices (IERS2010): within 3 m in
a low orbit of the IAU 1976/1980 theory that older software uses for them. The pseudo-Earth-fixed frame (TDR, GTOD, PEF)
is turned to ITRF with the polar motion of the day. Their turning against the stars, 1e-11 rad/s, is left out of
velocities.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

import erfa
import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.orbit.earth.frames import Frame, polar_motion_matrix
from magcal_core.orbit.earth.timescales import julian_tt

FRAME_OF_NAME: Final[Mapping[str, Frame]] = {
    "GCRF": "GCRF", "ICRF": "GCRF", "GCRS": "GCRF", "EME2000": "EME2000", "J2000": "EME2000", "TEME": "TEME",
    "TEMEOFDATE": "TEME", "ITRF": "ITRF", "ECEF": "ITRF", "ECF": "ITRF", "WGS84": "ITRF",
}  # fmt: skip
"""Reference frames that a message may be in, written without ``-``, ``_``, blanks and the year of a realisation."""
OF_DATE: Final[Mapping[str, Frame]] = {
    "TOD": "GCRF", "TOD_EARTH": "GCRF", "MOD": "GCRF", "MOD_EARTH": "GCRF", "TDR": "ITRF", "GTOD": "ITRF",
    "PEF": "ITRF",
}  # fmt: skip
"""Frames of date, and what they are turned into."""


_REALISED: Final = re.compile(r"(ITRF|IGS|IGB|ICRF|GCRF|WGS84)(?:\d{1,4}|\(\w{1,6}\)|G\d{1,4})?")
"""A frame with the year or number of its realisation; those of the Earth-fixed ones are centimetres apart."""


def known_frames() -> tuple[str, ...]:
    """Return every name of a frame that a message may have, but for years of realisations."""
    return (*FRAME_OF_NAME, *OF_DATE)


def is_known(name: str) -> bool:
    """Return whether a message may be in a frame."""
    return _plain(name) in FRAME_OF_NAME or name.strip().upper() in OF_DATE


def _plain(name: str) -> str:
    """Return a frame's name without ``-``, ``_``, blanks and the year of its realisation."""
    plain = re.sub(r"[-_ ]", "", name.upper())
    found = _REALISED.fullmatch(plain)
    if found is None:
        return plain
    return "ITRF" if found[1] in {"IGS", "IGB"} else found[1]


def in_known_frame(name: str, t_utc: Times, r_km: Floats, v_km_s: Floats) -> tuple[Frame, Floats, Floats]:
    """Return the frame, and positions and velocities in it, shape (n, 3) each, of states in the frame ``name``.

    Only frames of date are turned; the others stay as they are.
    """
    if _plain(name) in FRAME_OF_NAME:
        return FRAME_OF_NAME[_plain(name)], r_km, v_km_s
    name = name.strip().upper()
    if OF_DATE[name] == "ITRF":
        turned = polar_motion_matrix(t_utc)
    else:
        matrix = erfa.pnm06a if name.startswith("TOD") else erfa.pmat06
        turned = np.swapaxes(np.asarray(matrix(*julian_tt(t_utc)), np.float64), -1, -2)
    return OF_DATE[name], np.einsum("nij,nj->ni", turned, r_km), np.einsum("nij,nj->ni", turned, v_km_s)

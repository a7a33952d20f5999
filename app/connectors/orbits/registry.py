"""The sources of orbits by name: one file and one line each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from app.connectors.orbits.celestrak import CelesTrak
from app.connectors.orbits.contract import OrbitSource
from app.connectors.orbits.folder import Folder
from app.connectors.orbits.satnogs import SatNogs
from app.connectors.orbits.space_track import SpaceTrack
from app.connectors.orbits.url_template import UrlTemplate

ORBIT_SOURCES: Final[Mapping[str, OrbitSource]] = {
    "celestrak": CelesTrak(),
    "space-track": SpaceTrack(),
    "satnogs": SatNogs(),
    "url": UrlTemplate(),
    "folder": Folder(),
}

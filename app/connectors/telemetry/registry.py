"""The kinds of archives by name: one file and one line each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from app.connectors.telemetry.contract import Archive
from app.connectors.telemetry.hapi import Hapi
from app.connectors.telemetry.satnogs import SatNogs
from app.connectors.telemetry.yamcs import Yamcs

ARCHIVES: Final[Mapping[str, Archive]] = {"yamcs": Yamcs(), "satnogs": SatNogs(), "hapi": Hapi()}

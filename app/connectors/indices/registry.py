"""The sources of indices by name: one file and one line each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from app.connectors.indices.contract import IndexSource
from app.connectors.indices.gfz_kp import GfzKp
from app.connectors.indices.kyoto_dst import KyotoDst

INDEX_SOURCES: Final[Mapping[str, IndexSource]] = {"gfz-kp": GfzKp(), "kyoto-dst": KyotoDst()}

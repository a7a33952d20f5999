"""Gauss coefficients of the IGRF, read from the `.shc` files that come with the package ppigrf."""

from __future__ import annotations

import hashlib
import importlib.util
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.errors import ModelRangeError

IGRF_SHA256: Final = {
    13: "357536152bb6f72ced3eb886def84f91a592512465c367ca5ab7bda4c36c3522",
    14: "717f6dce821a8f2bfcc6a77f79cc227ba91f61aeb458d5433e8c72450d48f8e0",
}
"""Generation of the IGRF -> SHA-256 of its coefficient file."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussCoefficients:
    """Schmidt quasi-normalised coefficients at knots; between them they are linear in time.

    Attributes
    ----------
    knots_ns : int64, shape (k,)
        Nanoseconds since 1970, UTC.
    g_nt, h_nt : shape (k, 14, 14)
        Coefficients g[n, m] and h[n, m], nT.
    """

    knots_ns: Nanoseconds
    g_nt: Floats
    h_nt: Floats

    def at(self, t_utc: np.datetime64) -> GaussCoefficients:
        """Return the coefficients of one instant, as a model that no longer changes.

        Raises
        ------
        ModelRangeError
            The instant is outside the knots.
        """
        stamp = int(t_utc.astype("datetime64[ns]").astype(np.int64))
        if not self.knots_ns[0] <= stamp <= self.knots_ns[-1]:
            raise ModelRangeError(f"field model at {t_utc}: it is valid from {self.first} to {self.last}")
        k = min(int(np.searchsorted(self.knots_ns, stamp, side="right")) - 1, len(self.knots_ns) - 2)
        part = (stamp - self.knots_ns[k]) / (self.knots_ns[k + 1] - self.knots_ns[k])
        ends = np.array([-(2**62), 2**62 - 1])
        g_nt, h_nt = (a[k] + part * (a[k + 1] - a[k]) for a in (self.g_nt, self.h_nt))
        return GaussCoefficients(ends, np.stack([g_nt, g_nt]), np.stack([h_nt, h_nt]))

    @property
    def first(self) -> str:
        """First day of validity."""
        return str(np.datetime64(int(self.knots_ns[0]), "ns").astype("datetime64[D]"))

    @property
    def last(self) -> str:
        """Last instant of validity, at 0 h of this day."""
        return str(np.datetime64(int(self.knots_ns[-1]), "ns").astype("datetime64[D]"))


@lru_cache(maxsize=len(IGRF_SHA256))
def igrf_coefficients(version: int) -> GaussCoefficients:
    """Return the coefficients of IGRF-``version``, read once in a process (IGRF14).

    Raises
    ------
    ModelRangeError
        There is no such generation here, or its file is not the one whose hash is known.
    """
    if version not in IGRF_SHA256:
        raise ModelRangeError(f"IGRF-{version} is not known; known are {', '.join(map(str, IGRF_SHA256))}")
    spec = importlib.util.find_spec("ppigrf")
    if spec is None or not spec.submodule_search_locations:
        raise ModelRangeError("the coefficient files of the IGRF are missing: package ppigrf is not installed")
    file = Path(spec.submodule_search_locations[0]) / f"IGRF{version}.shc"
    content = file.read_bytes()
    if hashlib.sha256(content).hexdigest() != IGRF_SHA256[version]:
        raise ModelRangeError(f"{file.name} of ppigrf is not the file that magcal knows: its SHA-256 differs")
    return parse_shc(content.decode("ascii"))


def parse_shc(text: str) -> GaussCoefficients:
    """Return the coefficients in an `.shc` text whose knots are whole years."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    degree = int(rows[0][1])
    years = [int(float(year)) for year in rows[1]]
    knots_ns = np.array([f"{year}-01-01" for year in years], "datetime64[ns]").astype(np.int64)
    g_nt = np.zeros((len(years), degree + 1, degree + 1))
    h_nt = np.zeros_like(g_nt)
    for row in rows[2:]:
        n, m, values = int(row[0]), int(row[1]), np.array(row[2:], np.float64)
        if m >= 0:
            g_nt[:, n, m] = values
        else:
            h_nt[:, n, -m] = values
    return GaussCoefficients(knots_ns, g_nt, h_nt)

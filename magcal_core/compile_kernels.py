"""Compile every kernel once: `python -m magcal_core.compile_kernels`, so that the first calibration does not wait.

Numba keeps what it compiles beside the sources (or in ``NUMBA_CACHE_DIR``). What is compiled is what calibrations
call, so made-up sessions are calibrated, one method after the other; two processes share the methods where there are
two cores.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from typing import Final

from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.result import Calibration
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of

CORES: Final = 2


def calibrate_made_up_session(method: str) -> Calibration:
    """Return the calibration of a made-up session by ``method``; whatever it calls is compiled and kept."""
    samples, orbit = simulated(SESSIONS[0]).samples, Sgp4Orbit(tle_of(SESSIONS[0]))
    return calibrate(samples, [orbit], method=method, field="igrf-14+mean", with_moments=True)


def _compile(method: str) -> None:
    calibrate_made_up_session(method)


def main() -> None:
    """Calibrate by each method and say how far it has come, on one line."""
    begun = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(min(CORES, os.cpu_count() or 1)) as pool:
        for done, _ in enumerate(pool.imap_unordered(_compile, ESTIMATORS), 1):
            sys.stderr.write(f"\rcompiling kernels: {done} of {len(ESTIMATORS)} methods")
            sys.stderr.flush()
    sys.stderr.write(f"\rcompiled the kernels in {time.monotonic() - begun:.0f} s       \n")


if __name__ == "__main__":
    main()

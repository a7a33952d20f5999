"""Compile every kernel once: `python -m magcal_core.compile_kernels`, so that the first calibration does not wait.

Numba keeps what it compiles beside the sources (or in ``NUMBA_CACHE_DIR``). What is compiled is what work calls, so
made-up sessions are calibrated by each method, with bad rows, with wrong input, with an integrated orbit; two processes
share the works where there are two cores.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.result import Calibration
from magcal_core.errors import MagcalError
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_of

CORES: Final = 2


def calibrate_made_up_session(method: str) -> Calibration:
    """Return the calibration of a made-up session by ``method``; whatever it calls is compiled and kept."""
    samples, orbit = simulated(SESSIONS[0]).samples, Sgp4Orbit(tle_of(SESSIONS[0]))
    return calibrate(samples, [orbit], method=method, field="igrf-14+mean", with_moments=True)


def _bad_rows() -> None:
    """Calibrate sessions a quarter of whose readings are far off, by both kinds of method, and look for the cause."""
    samples, orbit = simulated(SESSIONS[0], 300).samples, Sgp4Orbit(tle_of(SESSIONS[0]))
    bad = samples.h_nt.copy()
    bad[::4] += 30_000.0
    for method in ("scalar", "vector"):
        calibrate(replace(samples, h_nt=bad), [orbit], method=method)


def _wrong_input() -> None:
    """Calibrate a session whose axes are in the wrong order, and one with columns of angular rate."""
    samples, orbit = simulated(SESSIONS[0], 300).samples, Sgp4Orbit(tle_of(SESSIONS[0]))
    calibrate(replace(samples, h_nt=samples.h_nt[:, [1, 0, 2]]), [orbit], method="vector")
    rates = {name: np.full(len(samples), rate) for name, rate in zip(("wx", "wy", "wz"), (0.3, 0.2, 0.1), strict=True)}
    calibrate(replace(samples, housekeeping=rates), [orbit], gyro=tuple(rates))


def _other_work() -> None:
    """Calibrate with an integrated orbit, and simulate some minutes of attitude control."""
    from magcal_core.attitude.options import attitude_job

    samples, orbit = simulated(SESSIONS[0], 300).samples, Sgp4Orbit(tle_of(SESSIONS[0]))
    calibrate(samples, [orbit], orbit="numerical")
    attitude_job({"duration_s": 300.0})


def _compile(name: str) -> None:
    with suppress(MagcalError):  # what is refused has been compiled all the same
        WORKS[name]() if name in WORKS else calibrate_made_up_session(name)


WORKS: Final[Mapping[str, Callable[[], None]]] = {
    "bad rows": _bad_rows,
    "wrong input": _wrong_input,
    "other work": _other_work,
}
"""What is done beside a calibration by each method."""


def compiled_mark() -> Path:
    """Return the file that says that every kernel has been compiled; named so that it goes where an index goes."""
    folder = os.environ.get("NUMBA_CACHE_DIR")
    return (Path(folder) if folder else Path(__file__).parent / "__pycache__") / "compiled.nbi"


def main() -> None:
    """Do each work and say how far it has come, on one line."""
    begun, works = time.monotonic(), [*ESTIMATORS, *WORKS]
    with multiprocessing.get_context("spawn").Pool(min(CORES, os.cpu_count() or 1)) as pool:
        for done, _ in enumerate(pool.imap_unordered(_compile, works), 1):
            sys.stderr.write(f"\rcompiling kernels: {done} of {len(works)}")
            sys.stderr.flush()
    compiled_mark().parent.mkdir(parents=True, exist_ok=True)
    compiled_mark().touch()
    sys.stderr.write(f"\rcompiled the kernels in {time.monotonic() - begun:.0f} s       \n")


if __name__ == "__main__":
    main()

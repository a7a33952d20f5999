"""The IGRF: ours against ppigrf at its best, chaosmagpy and a bare C kernel; what simpler models cost in nT.

``python -m benchmarks field`` measures; ``python -m benchmarks.field`` prints the table of what simpler models cost.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Figure, interleaved_s
from magcal_core.field.igrf import Igrf
from magcal_core.field.shc import igrf_coefficients
from magcal_core.orbit.messages.tle import parse_tles
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.reference.field_along_orbit import field_along

Floats = NDArray[np.float64]
Times = NDArray[np.datetime64]

SAMPLES = 100_000
CHUNK = 2_000
RADIUS_KM = 6371.2
DENSE = 1_000_000
TLES = Path(__file__).resolve().parent.parent / "tests" / "data" / "dekart.tle.txt"
SIMPLER = {
    "9x9": Igrf(14, 9),
    "9x9 of IGRF-13 at 2020.0 (the DEKART paper)": Igrf(13, 9, np.datetime64("2020-01-01", "ns")),
    "13x13 of IGRF-13": Igrf(13),
    "13x13 at 2020.0": Igrf(14, 13, np.datetime64("2020-01-01", "ns")),
}


def _samples(n: int) -> tuple[Times, Floats]:
    """Distinct times within 2022 in order, and places all round the Earth at 300 to 800 km."""
    rng = np.random.default_rng(1)
    seconds = np.sort(rng.uniform(0, 365 * 86400, n))
    t_utc = np.datetime64("2022-01-01", "ns") + (seconds * 1e9).astype("timedelta64[ns]")
    places = rng.normal(size=(n, 3))
    return t_utc, places * (rng.uniform(6671.0, 7171.0, n) / np.linalg.norm(places, axis=1))[:, None]


def _spherical(r_km: Floats) -> tuple[Floats, Floats, Floats]:
    radius_km = np.linalg.norm(r_km, axis=1)
    theta = np.degrees(np.arccos(r_km[:, 2] / radius_km))
    return radius_km, theta, np.degrees(np.arctan2(r_km[:, 1], r_km[:, 0]))


def ppigrf_at_its_best(t_utc: Times, r_km: Floats) -> Callable[[], Floats]:
    """ppigrf at two dates for all places, chunked to stay in the cache, and linear in time between."""
    ppigrf = importlib.import_module("ppigrf")
    ends = np.array([t_utc[0], t_utc[-1]]).astype("datetime64[us]").tolist()
    part = (t_utc - t_utc[0]) / (t_utc[-1] - t_utc[0])

    def run() -> Floats:
        field_nt = np.empty((len(t_utc), 3))
        radius_km, theta_deg, phi_deg = _spherical(r_km)
        for start in range(0, len(t_utc), CHUNK):
            rows = slice(start, start + CHUNK)
            two = np.stack(ppigrf.igrf_gc(radius_km[rows], theta_deg[rows], phi_deg[rows], ends), -1)
            field_nt[rows] = two[0] + part[rows, None] * (two[1] - two[0])
        return field_nt

    return run


def chaosmagpy_model(t_utc: Times, r_km: Floats) -> Callable[[], object]:
    """Chaosmagpy's spline model on the same coefficients."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says that Matplotlib is not installed
        chaos = importlib.import_module("chaosmagpy").chaos
    folder = Path(str(importlib.import_module("ppigrf").__file__)).parent
    model = chaos.BaseModel.from_shc(str(folder / "IGRF14.shc"), leap_year=True)
    days = (t_utc - np.datetime64("2000-01-01", "ns")) / np.timedelta64(1, "D")
    return lambda: model.synth_values(days, *_spherical(r_km))


def c_kernel(t_utc: Times, r_km: Floats, folder: Path) -> Callable[[], Floats] | None:
    """The bare kernel, compiled with this machine's vector instructions; None without a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        return None
    library = folder / "igrf_kernel.so"
    source = Path(__file__).with_name("igrf_kernel.c")
    flags = ["-O3", "-march=native", "-mprefer-vector-width=512", "-ffast-math", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, str(source), "-o", str(library), "-lm"], check=True)
    block = ctypes.CDLL(str(library)).igrf_block
    gauss = igrf_coefficients(14)
    k = int(np.searchsorted(gauss.knots_ns, t_utc[0].astype(np.int64), side="right")) - 1
    tables = [np.ascontiguousarray(a) for b in (gauss.g_nt, gauss.h_nt) for a in (b[k], b[k + 1] - b[k])]
    part = (t_utc.astype(np.int64) - gauss.knots_ns[k]) / (gauss.knots_ns[k + 1] - gauss.knots_ns[k])
    columns = [np.ascontiguousarray(part), *(np.ascontiguousarray(r_km[:, i] / RADIUS_KM) for i in range(3))]
    out = np.empty(3 * len(part))
    pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (*tables, *columns, out)]

    def run() -> Floats:
        block(*pointers, ctypes.c_long(len(part)))
        return out

    return run


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    t_utc, r_km = _samples(SAMPLES - SAMPLES % 16)
    model = Igrf()
    cores = os.sched_getaffinity(0)
    with tempfile.TemporaryDirectory() as folder:
        candidates: dict[str, Callable[[], object]] = {"ours": lambda: model.field_itrf_nt(t_utc, r_km)}
        candidates["ppigrf"] = ppigrf_at_its_best(t_utc, r_km)
        candidates["chaosmagpy"] = chaosmagpy_model(t_utc, r_km)
        if (bare := c_kernel(t_utc, r_km, Path(folder))) is not None:
            candidates["C kernel"] = bare
        all_s = interleaved_s(candidates, rounds=5)
        os.sched_setaffinity(0, {min(cores)})
        one_s = interleaved_s(
            {name: run for name, run in candidates.items() if name in ("ours", "C kernel")}, rounds=15
        )
        os.sched_setaffinity(0, cores)
    n = len(t_utc)
    yield Figure("field", f"IGRF-14 13x13, {n} samples, all cores", n / all_s["ours"] / 1e6, "M/s")
    yield Figure("field", f"IGRF-14 13x13, {n} samples, one core", n / one_s["ours"] / 1e6, "M/s", "", None, "aim 11")
    ratio = all_s["ppigrf"] / all_s["ours"]
    yield Figure("field", "ppigrf at its best / ours", ratio, "x", ">= 80", ratio >= 80, f"{n / all_s['ppigrf']:.0f}/s")
    yield Figure("field", "chaosmagpy / ours", all_s["chaosmagpy"] / all_s["ours"], "x")
    if "C kernel" in one_s:
        ratio = one_s["ours"] / one_s["C kernel"]
        rate = f"{n / one_s['C kernel'] / 1e6:.1f} M/s"
        yield Figure("field", "ours / bare C kernel, one core each", ratio, "x", "<= 2", ratio <= 2.0, rate)
    yield from dense_figures()


def dense_figures() -> Iterator[Figure]:
    """Yield what the field along an orbit, once a second, costs at every sample beside what it costs as it is done."""
    orbit, model = Sgp4Orbit(parse_tles(TLES.read_text())[0]), Igrf()
    t_utc = orbit.epoch_utc + np.arange(DENSE) * np.timedelta64(1, "s")

    def every() -> Floats:
        return model.field_itrf_nt(t_utc, orbit.position_itrf_km(t_utc))

    def along() -> Floats:
        track = field_along(orbit, model, t_utc, is_gcrf=False)
        if track is None:
            raise RuntimeError("samples of a second apart are too sparse to be interpolated")
        return track.at(t_utc)

    away_nt = float(np.abs(along() - every()).max())
    spent_s = interleaved_s({"every": every, "along": along}, rounds=5, clock=time.process_time)
    ratio = spent_s["every"] / spent_s["along"]
    note = f"{1e3 * spent_s['along']:.0f} ms of processor, position and all; away by {away_nt:.4f} nT at most"
    is_met = ratio >= 3.0 and away_nt <= 0.01
    what = f"field at every sample / along the orbit, {DENSE} samples, 1 Hz"
    yield Figure("field", what, ratio, "x", ">= 3 within 0.01 nT", is_met, note)


def costs() -> Iterator[tuple[str, str, float, float]]:
    """Yield model, session, rms and largest difference of |B| from IGRF-14 13x13, nT, over a day of DEKART."""
    for tle in parse_tles(TLES.read_text()):
        orbit = Sgp4Orbit(tle)
        t_utc = orbit.epoch_utc + np.arange(0, 86400, 10).astype("timedelta64[s]")
        r_km = orbit.position_itrf_km(t_utc)
        full_nt = np.linalg.norm(Igrf().field_itrf_nt(t_utc, r_km), axis=1)
        for name, model in SIMPLER.items():
            away_nt = np.linalg.norm(model.field_itrf_nt(t_utc, r_km), axis=1) - full_nt
            yield name, tle.name, float(np.sqrt(np.mean(away_nt**2))), float(np.abs(away_nt).max())


if __name__ == "__main__":
    for model_name, session, rms_nt, max_nt in costs():
        print(f"{model_name:45} {session:18} rms {rms_nt:6.1f} nT   max {max_nt:6.1f} nT")

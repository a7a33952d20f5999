"""Time and memory of a calibration against the number of samples, 1e2 to 1e7, each size in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from benchmarks.measure import Figure

ROOM = "growth"
RESULTS = Path(__file__).parent / "results"
SIZES = (100, 1_000, 10_000, 100_000, 1_000_000, 10_000_000)
SPAN_S = 11.0 * 86_400.0
"""The largest sessions sample this span faster and faster; the smallest sample every 10 s."""
MOST_MIB = 1024.0
LINEAR = 1.1
"""Exponent of growth up to which it passes for linear."""
_FROM = 10_000

_CHILD = """
import json, resource, sys, time
from pathlib import Path
from benchmarks.growth import step_s
from benchmarks.pipeline import orbit, telemetry
from magcal_core.pipeline import calibrate

def status(name):
    return int(Path("/proc/self/status").read_text().split(name)[1].split()[0]) / 1024

n = int(sys.argv[1])
calibrate(telemetry(2000, 10.0), [orbit()], robust="soft_l1", time_offset="none")
samples = telemetry(n, step_s(n))
runs = 5 if n <= 10_000 else 1
Path("/proc/self/clear_refs").write_text("5")
before = status("VmRSS:")
wall, used = time.perf_counter(), time.process_time()
for _ in range(runs):
    calibrate(samples, [orbit()], robust="soft_l1", time_offset="none")
wall, used = time.perf_counter() - wall, time.process_time() - used
print(json.dumps([n, wall / runs, used / runs, status("VmHWM:") - before]))
"""


@dataclass(frozen=True, slots=True)
class Point:
    """One size: samples, wall and processor time, s, and peak memory beside the samples themselves, MiB."""

    samples: int
    wall_s: float
    cpu_s: float
    extra_mib: float


def step_s(n: int) -> float:
    """Return the sampling step, s, of a session of ``n`` samples."""
    return min(10.0 if n > 100 else 60.0, SPAN_S / n)


def point(n: int) -> Point:
    """Return what a calibration of ``n`` samples costs."""
    done = subprocess.run([sys.executable, "-c", _CHILD, str(n)], capture_output=True, text=True, check=True)
    return Point(*json.loads(done.stdout))


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return p of costs ~ sizes^p by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def draw(points: Sequence[Point]) -> Path:
    """Write the plot of time and memory against size, and return where."""
    sizes = [each.samples for each in points]
    figure = go.Figure()
    figure.add_scatter(x=sizes, y=[each.cpu_s for each in points], name="processor time, s", mode="lines+markers")
    figure.add_scatter(x=sizes, y=[each.wall_s for each in points], name="wall time, s", mode="lines+markers")
    figure.add_scatter(
        x=sizes, y=[each.extra_mib for each in points], name="memory beside the samples, MiB", mode="lines+markers",
        yaxis="y2",
    )  # fmt: skip
    figure.update_layout(
        title="A calibration against its number of samples",
        xaxis={"type": "log", "title": "samples"},
        yaxis={"type": "log", "title": "s"},
        yaxis2={"type": "log", "title": "MiB", "overlaying": "y", "side": "right"},
    )
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "growth.html"
    figure.write_html(path, include_plotlyjs="directory")
    return path


def figures() -> Iterator[Figure]:
    """Yield time and memory of every size, and how they grow."""
    points = [point(n) for n in SIZES]
    for each in points:
        what = f"calibration of {each.samples:.0e} samples"
        yield Figure(ROOM, what, each.cpu_s, "s", note=f"wall {each.wall_s:.3g} s, {each.extra_mib:.0f} MiB")
    large = [each for each in points if each.samples >= _FROM]
    sizes = [each.samples for each in large]
    grows = exponent(sizes, [each.cpu_s for each in large])
    yield Figure(ROOM, "time ~ samples^p from 1e4 on", grows, "p", f"<= {LINEAR:g}", grows <= LINEAR)
    heavy = [each for each in large if each.extra_mib > 50.0]
    if len(heavy) > 1:
        grows = exponent([each.samples for each in heavy], [each.extra_mib for each in heavy])
        yield Figure(ROOM, "memory ~ samples^p", grows, "p", f"<= {LINEAR:g}", grows <= LINEAR)
    most = points[-1].extra_mib
    note = "reference, residual table and fit, beside the samples"
    yield Figure(ROOM, "memory of 1e7 samples", most, "MiB", f"<= {MOST_MIB:g}", most <= MOST_MIB, note)
    yield Figure(ROOM, "plot", float(len(points)), "sizes", note=str(draw(points).relative_to(RESULTS.parent.parent)))

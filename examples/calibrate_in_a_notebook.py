# %% [markdown]
# # A calibration without a server
#
# Cells of a notebook (`# %%`): run them in VS Code, Spyder or Jupyter (through jupytext), or the file as it is.
# Times are `datetime64[ns]` in UTC, arrays have shape (n, 3), fields are in nT.

# %%
from pathlib import Path

import numpy as np

import magcal_core as mc
from app.records.parameter_set import parameter_set_record
from app.reporting import figures
from app.reporting.report import render_report

TLE = """DEKART 2022-02-19
1 46493U 20068H   22050.94287187  .00000000  00000-0  00000+0 0  9996
2 46493  97.7186 352.5293 0017269 326.3404  33.6715 15.04187815    07
"""

# %% [markdown]
# ## Telemetry
# Simulated here, so that the truth is known; with a file of your own it is
# `samples = mc.read_samples("telemetry.csv", unit="uT", columns={"time": "ts", "bx": "mag_x"})`.

# %%
orbit = mc.Sgp4Orbit.from_tle(TLE)
truth = mc.SensorModel([2928.1, -1191.3, -1875.6], [1.0327, 1.0067, 1.0329], [-4.53, -1.07, 7.92])
start = np.datetime64("2022-02-19T22:37:44", "ns")
simulation = mc.simulate(orbit, truth, start, 6000.0, 10.0, seed=1)
samples = simulation.samples
print(f"{len(samples)} samples from {samples.t_utc[0]} to {samples.t_utc[-1]}")

# %% [markdown]
# ## Calibration

# %%
calibration = mc.calibrate(samples, orbits=[orbit], method="scalar")
print(calibration.verdict.grade, *(reason.text for reason in calibration.verdict.reasons), sep="; ")
print(f"RMS {calibration.before.rms_nt:.0f} nT before, {calibration.after.rms_nt:.1f} nT after")
for name, value, error in zip(
    calibration.parameters.names,
    calibration.parameters.vector,
    calibration.standard_errors.vector,
    strict=True,
):
    print(f"{name:24s} {value:12.5f} +- {error:.5f}")

# %% [markdown]
# ## Figures and report
# The figures are those of the dashboard; in a notebook the last line of a cell shows one.

# %%
figure = figures.before_after(calibration.residuals)
figure

# %%
record = parameter_set_record(calibration.to_dict())
Path("report.html").write_text(render_report(record, calibration.residuals), encoding="utf-8")

# %% [markdown]
# ## Correct new readings

# %%
sensor = mc.SensorModel.from_matrix(calibration.parameters.bias_nt, calibration.matrix)
corrected_nt = sensor.correct(samples.h_nt)
print("mean |B| corrected:", round(float(np.nanmean(np.linalg.norm(corrected_nt, axis=1)))), "nT")

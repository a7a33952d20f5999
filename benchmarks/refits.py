"""What a session costs once more: refits, blocks left out, bootstrap, regressors, clock, from samples and from moments.

From its stored moments each takes milliseconds at any number of samples; the estimate alone is to take 2 ms
(``magcal_core.calibration.refit.refit``), the rest is honest errors, models tried and replicates.

A pass is one evaluation of the fit's kernel, cost, gradient and normal matrix, over all samples, of which a refit takes
three or four. Processor time: all threads count. At 700 samples a refit and its blocks may take a quarter of a whole
calibration's 20 ms, what is asked for beside it as much as the calibration. At 1e5, where a pass takes more than a
millisecond, a refit may take 15, six blocks two refits, 200 replicates four: one and three are refitted, the others
stepped to. A choice among six columns and a search for the clock, which have to fit and to compute the reference anew,
may take the 250 passes that are a calibration's 400 ms.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Figure, interleaved_s
from benchmarks.pipeline import orbit, telemetry
from magcal_core.calibration.estimators.contract import Fit, FitSettings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.estimators.scalar_kernel import accumulate
from magcal_core.calibration.refit.moments import FitMoments
from magcal_core.calibration.refit.outcome import RefitOptions
from magcal_core.calibration.refit.refit import refit
from magcal_core.calibration.sessions.monitoring import ActiveSet, judge_moments, judge_session, moments_of
from magcal_core.calibration.terms.clock import fit_with_clock
from magcal_core.calibration.terms.regressor_evidence import SmoothBias
from magcal_core.calibration.terms.regressor_selection import choose_regressors
from magcal_core.calibration.uncertainty.bootstrap import bootstrap
from magcal_core.calibration.uncertainty.cross_validation import held_out_residuals_nt
from magcal_core.calibration.uncertainty.reweighted_blocks import steps_of
from magcal_core.estimation.session import LockedSession
from magcal_core.observations import Observations
from magcal_core.options import CalibrationOptions
from magcal_core.pipeline import calibrate
from magcal_core.reference.referenced_samples import Referenced
from magcal_core.samples import Samples
from magcal_core.sensor.parameterisation import Standardised, theta_of_parameters

ROOM = "refits"
LOSS = "soft_l1"
COLUMNS = 6
REPLICATES = 200
"""Enough for a standard error to 5 %."""
BLOCK = 16
"""Samples of a bootstrap's block at 700; in proportion at more."""
FROM_MOMENTS_MS = {"estimate": 2.0, "refit": 10.0, "clock": 10.0, "bootstrap": 40.0, "regressors": 40.0}
AIMS_MS = {"refit": 5.0, "blocks": 5.0, "bootstrap": 20.0, "regressors": 20.0, "clock": 20.0}
AIMS_PASSES = {"refit": 15.0, "blocks": 30.0, "bootstrap": 60.0, "regressors": 250.0, "clock": 250.0}
NAMES = {
    "refit": "refit from the fit to one half",
    "blocks": "cross-validation over six blocks",
    "bootstrap": f"bootstrap, {REPLICATES} replicates",
    "regressors": f"regressors chosen among {COLUMNS} columns",
    "clock": "search for the clock's offset",
    "reference": "position and field of every sample",
    "monitor": "judged against an active set, from samples with their reference",
    "moments": "judged against an active set, from moments",
    "calibration": "the whole calibration, from samples without a reference",
}
KEPT_NAMES = {
    "read": "moments read from their file",
    "estimate": "from moments: the estimate without half of the blocks",
    "refit": "from moments: refit with honest errors and cross-validation",
    "clock": "from moments: the same with the clock's offset",
    "regressors": f"from moments: regressors chosen among {COLUMNS} columns",
    "bootstrap": f"from moments: bootstrap, {REPLICATES} replicates",
}
_ROUNDS = {700: 15, 100_000: 5}
_REPEATS = {700: 500, 100_000: 5}
"""Passes that are timed together: one alone is shorter than the clock's tick."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session in memory with its reference, its columns, a fit to all of it and one to its first half."""

    samples: Samples
    referenced: Referenced
    usable: NDArray[np.bool_]
    observations: Observations
    settings: FitSettings
    near: Fit
    half: Fit

    @classmethod
    def of(cls, n: int) -> Session:
        """Return a session of ``n`` samples, whose columns say nothing, under a robust loss."""
        random = np.random.default_rng(n)
        columns = {f"column {i}": np.cumsum(random.normal(size=n)) / np.sqrt(n) for i in range(COLUMNS)}
        samples = replace(telemetry(n, 10.0 if n < 10_000 else 1.0), housekeeping=columns)
        referenced = Referenced.of(samples, [orbit()], CalibrationOptions(robust=LOSS))
        usable, settings, fit = referenced.usable((), False), FitSettings(LOSS), ESTIMATORS["scalar"].fit
        observations = referenced.observations(usable, ())
        half = observations.take(slice(0, n // 2))
        return cls(
            samples, referenced, usable, observations, settings, fit(observations, settings), fit(half, settings)
        )

    def candidates(self) -> Mapping[str, Callable[[], object]]:
        """Return what takes turns, by the keys of `NAMES`, beside a bare pass."""
        scalar, o, settings, near = ESTIMATORS["scalar"], self.observations, self.settings, self.near
        active = ActiveSet(near.parameters, near.covariance, near.sigma_nt, is_vector=False)
        kept = moments_of(o, near.parameters, is_vector=False)
        block = max(BLOCK, BLOCK * len(o) // 700)
        locked = LockedSession(self.referenced, self.usable, is_vector=False)
        smooth = SmoothBias(locked.columns(o, near), seed=1)
        columns = self.referenced.observations(self.usable, tuple(self.samples.housekeeping))

        def at(shift_s: NDArray[np.float64], rows: slice) -> Observations:
            return self.referenced.shifted(self.usable, (), shift_s, rows)

        return {
            "pass": self.passes,
            "refit": partial(scalar.refit, o, settings, self.half),
            "blocks": partial(held_out_residuals_nt, scalar, o, settings, near),
            "bootstrap": partial(bootstrap, scalar, o, settings, near, block, REPLICATES, 1),
            "regressors": partial(choose_regressors, scalar, columns, settings, smooth),
            "clock": partial(fit_with_clock, scalar, at, o, settings, has_drift=False),
            "reference": partial(self.referenced.shifted, self.usable, (), np.zeros(len(o))),
            "monitor": partial(judge_session, o, active),
            "moments": partial(judge_moments, kept, active),
            "calibration": partial(
                calibrate, self.samples, [orbit()], robust=settings.robust, time_offset="estimate", regressors=()
            ),
        }

    def kept(self) -> Mapping[str, Callable[[], object]]:
        """Return what is made from the stored moments of a calibration, by the keys of `KEPT_NAMES`."""
        found = calibrate(self.samples, [orbit()], robust=LOSS, regressors=(), time_offset="none", with_moments=True)
        assert found.moments is not None
        content = found.moments.to_bytes()
        moments = FitMoments.from_bytes(content)
        sums, own = moments.sums, np.arange(9)
        scores, normals = sums.scores[:, own], sums.normals[:, own[:, None], own]
        half = np.ones((1, len(sums.costs)))
        half[:, len(sums.costs) // 2 :] = 0.0
        return {
            "read": partial(FitMoments.from_bytes, content),
            "estimate": partial(steps_of, scores, normals, half),
            "refit": partial(refit, moments, RefitOptions()),
            "clock": partial(refit, moments, RefitOptions(time_offset=True)),
            "regressors": partial(refit, moments, RefitOptions("auto")),
            "bootstrap": partial(refit, moments, RefitOptions(bootstrap=REPLICATES)),
        }

    def passes(self) -> None:
        """Evaluate the kernel as often as `_REPEATS` says."""
        o, normal, gradient = self.observations, np.empty((9, 9)), np.empty(9)
        none = np.zeros((len(o), 0))
        theta = theta_of_parameters(self.near.parameters, Standardised.of((), (), len(o)))
        for _ in range(_REPEATS[len(o)]):
            accumulate(o.h_nt, o.b_nt, o.weights, none, none, theta, 0, 1.0, -1.0, False, normal, gradient)


def measured(n: int) -> Iterator[Figure]:
    """Yield the figures of a session of ``n`` samples."""
    times = interleaved_s(Session.of(n).candidates(), _ROUNDS[n], time.process_time)
    bare_s = times.pop("pass") / _REPEATS[n]
    what = f"{n:.0e} samples" if n >= 10_000 else f"{n} samples"
    yield Figure(ROOM, f"one bare pass, {what}", 1e3 * bare_s, "ms")
    for key, took_s in times.items():
        ms, passes = 1e3 * took_s, took_s / bare_s
        name = f"{NAMES[key]}, {what}"
        if n < 10_000:
            most = AIMS_MS.get(key)
            is_met, aim = (None, "") if most is None else (ms <= most, f"<= {most:g}")
            yield Figure(ROOM, name, ms, "ms", aim, is_met, f"{passes:.3g} bare passes")
        else:
            most = AIMS_PASSES.get(key)
            is_met, aim = (None, "") if most is None else (passes <= most, f"<= {most:g}")
            yield Figure(ROOM, name, passes, "bare passes", aim, is_met, f"{ms:.3g} ms of processor")


def from_moments(n: int) -> Iterator[Figure]:
    """Yield what refits from the stored moments of a session of ``n`` samples take."""
    times = interleaved_s(Session.of(n).kept(), _ROUNDS[n], time.process_time)
    what = f"{n:.0e} samples" if n >= 10_000 else f"{n} samples"
    for key, took_s in times.items():
        ms, most = 1e3 * took_s, FROM_MOMENTS_MS.get(key)
        is_met, aim = (None, "") if most is None else (ms <= most, f"<= {most:g}")
        yield Figure(ROOM, f"{KEPT_NAMES[key]}, {what}", ms, "ms", aim, is_met)


def figures() -> Iterator[Figure]:
    """Yield the figures of this room."""
    for n in _ROUNDS:
        yield from measured(n)
        yield from from_moments(n)

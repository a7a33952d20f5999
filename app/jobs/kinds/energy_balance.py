"""The kind of job that balances the energy of an orbit and recovers gravity coefficients from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final, Literal

import pyarrow as pa
from pydantic import AliasChoices, Field, JsonValue
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.access.caller import SYSTEM, Caller
from app.errors import NotFoundError
from app.http.schemas import Identifier, Slug
from app.jobs.kinds.contract import Admission, Claim, Outcome, Report, WrongKindError
from app.jobs.kinds.result_series import SERIES_POINTS, keep_series
from app.jobs.schemas import JobBody
from app.orbits.parsing import orbit_of, parse_message
from app.orbits.repository import OrbitRepository
from app.orbits.schemas import OrbitQuery
from app.orbits.tables import OrbitRow
from app.records.arrow import to_bytes
from app.satellites.repository import SatelliteRepository, within_reach
from app.storage.store import Store
from magcal_core.errors import Fault, OptionError
from magcal_core.orbit.messages.state import state_from_mapping

DAY_S: Final = 86400.0
STEP_S: Final = 30.0
SOURCES: Final = frozenset({"satellite", "orbit", "orbit_id", "state", "tle"})
PROPAGATORS: Final = frozenset({"numerical", "sgp4"})


class EnergyBody(JobBody):
    """Balance the energy along an orbit; what is left out has the default of `magcal energy`.

    The orbit is one of a satellite (`orbit`, or its newest), a state vector (`orbit` or `state`), or a TLE (`tle`).
    """

    kind: Literal["energy-balance"]
    satellite: Slug | None = None
    orbit: Identifier | Literal["numerical", "sgp4"] | dict[str, JsonValue] | None = Field(
        None, description="An orbit's id or a state vector; `numerical` or `sgp4` is the same as `propagator`."
    )
    orbit_id: Identifier | None = None
    state: dict[str, JsonValue] | None = None
    tle: str | None = Field(None, max_length=1000)
    propagator: Literal["numerical", "sgp4"] | None = Field(None, description="What becomes of a TLE.")
    duration_s: float | None = Field(None, validation_alias=AliasChoices("duration_s", "duration"))
    step_s: float = Field(STEP_S, validation_alias=AliasChoices("step_s", "step"))
    degree: int | None = None
    third_bodies: bool | None = None
    tide: bool | None = None
    form: str | None = Field(None, max_length=32)
    recover: int | None = None
    method: str | None = Field(None, max_length=32)
    noise_position_m: float | None = None
    noise_velocity_m_s: float | None = None
    seed: int | None = None
    rotation: Literal["iers", "uniform"] | None = None
    drag_density_kg_m3: float | None = None
    drag_area_over_mass_m2_kg: float | None = None
    drag_scale_height_km: float | None = None

    @property
    def options(self) -> dict[str, object]:
        """The options that were given, under the names of the balance."""
        values = self.model_dump(exclude={*JobBody.model_fields, *SOURCES, "propagator"})
        named = self.orbit if isinstance(self.orbit, str) and self.orbit in PROPAGATORS else None
        values["orbit"] = self.propagator or named
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, slots=True)
class EnergyWork:
    """What a balance works on: the orbit's text and its options as `EnergyOptions` takes them."""

    orbit: str
    options: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class _Source:
    """The orbit that a request names: where it is kept, or its text, and the span of an ephemeris."""

    satellite_id: str | None
    record: dict[str, object]
    epoch: datetime
    until: datetime | None


class EnergyKind:
    """Balances the energy of an orbit that is kept, or of one that comes with the request."""

    body: type[JobBody] = EnergyBody
    function = "app.jobs.kinds.energy_balance:balance"
    warm = ""

    def admit(self, session: Session, caller: Caller, body: JobBody) -> Admission:
        """Return what ``body`` asks for: its orbit must be there, and its options sound."""
        from magcal_core.energy.options import EnergyOptions

        if not isinstance(body, EnergyBody):
            raise WrongKindError("not an energy balance")
        source = _source(session, caller, body)
        span_s = None if source.until is None else (source.until - source.epoch) / timedelta(seconds=1)
        options = EnergyOptions.from_dict({"duration_s": DAY_S if span_s is None else span_s} | body.options)
        if span_s is not None and options.duration_s > span_s:
            fault = Fault("duration_s", f"the ephemeris is {span_s:.0f} s long")
            raise OptionError("energy balance: the ephemeris is shorter than the balance", [fault])
        return Admission({**options.to_dict(), **source.record}, source.satellite_id)

    def check(self, session: Session, admission: Admission) -> None:
        """Nothing is left to check: the orbit and the options are sound."""

    def load(self, session: Session, store: Store, claim: Claim) -> EnergyWork:
        """Return the orbit and the options of the claimed job."""
        options = dict(claim.request)
        content, orbit_id = options.pop("source", None), options.pop("orbit_id", None)
        if orbit_id is not None:
            content = OrbitRepository(session, SYSTEM, str(claim.satellite_id)).get(str(orbit_id)).content
        return EnergyWork(str(content), options)

    def keep(self, session: Session, store: Store, claim: Claim, found: Outcome) -> dict[str, object]:
        """Keep the series and return the summary."""
        return found.record | {"series": keep_series(session, store, claim.job_id, found.blobs["series"])}


def _source(session: Session, caller: Caller, body: EnergyBody) -> _Source:
    orbit_id = body.orbit if isinstance(body.orbit, str) and body.orbit not in PROPAGATORS else body.orbit_id
    state = body.orbit if isinstance(body.orbit, dict) else body.state
    given = [one for one in (orbit_id, state, body.tle) if one is not None]
    if len(given) > 1 or not (given or body.satellite):
        why = "want one of orbit, state and tle, or a satellite that has an orbit"
        raise OptionError(f"energy balance: {why}", [Fault("orbit", why)])
    if body.satellite is not None:
        SatelliteRepository(session, caller).get(body.satellite)
    if orbit_id is not None or not given:
        row = _kept(session, caller, body.satellite, orbit_id)
        return _Source(row.satellite_id, {"orbit_id": row.id}, row.epoch, row.until)
    if state is not None:
        parsed = parse_message(state_from_mapping(state).text.encode(), "application/json")
    else:
        parsed = parse_message(str(body.tle).encode(), "text/plain")
    if len(parsed) != 1 or parsed[0].format not in {"state", "tle"}:
        why = f"want one orbit, not {len(parsed)}; other forms are sent to the satellite's orbits and named by their id"
        raise OptionError(f"energy balance: {why}", [Fault("tle", why)])
    return _Source(body.satellite, {"source": parsed[0].content}, parsed[0].epoch, parsed[0].until)


def _kept(session: Session, caller: Caller, satellite_id: str | None, orbit_id: str | None) -> OrbitRow:
    """Return the orbit of that id, or else the satellite's newest."""
    if orbit_id is None:
        rows = OrbitRepository(session, caller, str(satellite_id)).page(OrbitQuery(limit=1)).rows
        if not rows:
            raise OptionError("energy balance: the satellite has no orbit", [Fault("satellite", "has no orbit")])
        return rows[0]
    reached = within_reach(OrbitRow.satellite_id, caller)
    row = session.scalar(select(OrbitRow).where(OrbitRow.id == orbit_id, reached))
    if row is None or satellite_id not in (None, row.satellite_id):
        raise NotFoundError("no such orbit")
    return row


def balance(work: object, _report: Report) -> Outcome:
    """Return summary and series of one balance; it runs in the child."""
    from magcal_core.energy.balance import energy_balance
    from magcal_core.energy.options import EnergyOptions
    from magcal_core.numerics.time_series import extreme_indices

    if not isinstance(work, EnergyWork):
        raise WrongKindError("not an energy balance")
    found = energy_balance(orbit_of(work.orbit), EnergyOptions.from_dict(work.options))
    record = found.to_dict()
    del record["options"]
    kept = extreme_indices(found.hamiltonian_m2_s2, SERIES_POINTS)
    times = pa.array(found.t_utc[kept].astype("datetime64[ns]")).cast(pa.timestamp("ns", "UTC"))
    columns = {"time": times} | {f"{name}_m2_s2": pa.array(one[kept]) for name, one in found.columns().items()}
    return Outcome(record, {"series": to_bytes(pa.table(columns))})

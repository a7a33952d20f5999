"""What is known to be aboard, as far as the caller's key reaches."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from decimal import Decimal
from typing import Final

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.aboard.comparison import Comparison, compare, flies
from app.aboard.reading import ReadBackError, read_back
from app.aboard.schemas import AboardBody, AboardQuery, AboardRead, AboardShort
from app.aboard.tables import AboardReport
from app.access.audit_trail import record_event
from app.access.caller import Caller
from app.http.paging import Ways, fetch_page, page_of
from app.http.schemas import Page
from app.parameter_sets.export import exported
from app.parameter_sets.export_formats import EXPORTERS
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import ExportQuery
from app.parameter_sets.tables import ParameterSet
from app.storage.database import new_id, utc_now

FEWEST_NUMBERS: Final = 6
MOST_SETS: Final = 200
"""Older sets that what is aboard is compared with, the newest of them."""
REPORTS: Final = Ways({"created": (AboardReport.id,)}, searched=(AboardReport.state, AboardReport.created_by))


@dataclass(frozen=True, slots=True)
class NotAboard:
    """A parameter set that is in force and not known to be aboard; ``state`` is how far it has come, None: nowhere."""

    parameter_set_id: str
    satellite_id: str
    magnetometer_id: str
    state: str | None


class AboardRepository:
    """The reports on parameter sets that a caller reaches."""

    def __init__(self, session: Session, caller: Caller) -> None:
        self.session = session
        self.caller = caller
        self._sets = ParameterSetRepository(session, caller)

    def report(self, parameter_set_id: str, body: AboardBody) -> AboardRead:
        """Return the report ``body`` on a parameter set, kept: compared where it is what was read back."""
        row = self._sets.get(parameter_set_id)
        if body.format is None or body.content is None:
            return self._keep(row, str(body.state), None, None)
        named, aboard = read_back(body.format, body.content, body.first_id)
        convention = named or body.convention or "exact"
        found = self._compared(row, body.format, convention, aboard)
        other = self._match(row, body.format, convention, aboard) if found.state == "different" else None
        return self._keep(row, found.state, found, other)

    def export(self, parameter_set_id: str, query: ExportQuery) -> tuple[str, str | bytes, bool]:
        """Return media type and content of an export, and whether it is the first step of a set in force on its way."""
        row = self._sets.get(parameter_set_id)
        content = exported(
            self._sets.read([row])[0], query.convention, query.format, first_id=query.first_id, has_crc=query.crc
        )
        return (*content, self._is_first_step(row))

    def note_exported(self, parameter_set_id: str) -> None:
        """Note that a set in force was exported, where nothing is known of its way yet."""
        row = self._sets.get(parameter_set_id)
        if self._is_first_step(row):
            self._keep(row, "exported", None, None)

    def _is_first_step(self, row: ParameterSet) -> bool:
        known = select(AboardReport.id).where(AboardReport.parameter_set_id == row.id).limit(1)
        return row.status == "active" and self.session.scalar(known) is None

    def history(self, parameter_set_id: str, query: AboardQuery) -> Page[AboardRead] | Page[AboardShort]:
        """Return a part of the reports on a parameter set."""
        row = self._sets.get(parameter_set_id)
        mine = select(AboardReport).where(AboardReport.parameter_set_id == row.id)
        found = fetch_page(self.session, mine, REPORTS, query)
        return page_of([_read(one) for one in found.rows], found, query, AboardShort)

    def _compared(self, row: ParameterSet, form: str, convention: str, aboard: Mapping[str, Decimal]) -> Comparison:
        """Return how the numbers of an export that is read the same way stand to those that were read back."""
        _, content = exported(self._sets.read([row])[0], convention, form)
        text = content if isinstance(content, str) else base64.b64encode(content).decode()
        numbers = {name: float(value) for name, value in read_back(form, text)[1].items() if flies(name)}
        common = numbers.keys() & aboard.keys()
        if len(common) < FEWEST_NUMBERS:
            raise ReadBackError(f"it has {len(common)} of the {len(numbers)} numbers of the export in {convention}")
        return compare(numbers, aboard, convention, is_single=EXPORTERS[form].is_single)

    def _match(self, row: ParameterSet, form: str, convention: str, aboard: Mapping[str, Decimal]) -> str | None:
        """Return the newest other set of the magnetometer that what was read back is, if it is one."""
        own = (ParameterSet.satellite_id == row.satellite_id, ParameterSet.magnetometer_id == row.magnetometer_id)
        others = select(ParameterSet).where(*own, ParameterSet.id != row.id).order_by(ParameterSet.id.desc())
        for one in self.session.scalars(others.limit(MOST_SETS)):
            if one.record.get("parameters") and self._compared(one, form, convention, aboard).state != "different":
                return one.id
        return None

    def _keep(self, row: ParameterSet, state: str, found: Comparison | None, other: str | None) -> AboardRead:
        report = AboardReport(
            id=new_id(),
            parameter_set_id=row.id,
            satellite_id=row.satellite_id,
            magnetometer_id=row.magnetometer_id,
            state="confirmed" if state == "rounded" else state,
            comparison=None if found is None else asdict(found),
            matches_parameter_set_id=other,
            created_at=utc_now(),
            created_by=self.caller.key_id,
        )
        self.session.add(report)
        record_event(self.session, self.caller, f"parameter_set.{report.state}", row.id, row.satellite_id)
        self.session.flush()
        return _read(report)


def not_aboard(session: Session, satellites: Sequence[str] | None = None) -> list[NotAboard]:
    """Return the sets in force that the last report on their magnetometer does not confirm to be aboard.

    ``satellites``: of these alone.
    """
    of = [] if satellites is None else [ParameterSet.satellite_id.in_(satellites)]
    of_reports = [] if satellites is None else [AboardReport.satellite_id.in_(satellites)]
    newest = (
        select(AboardReport.satellite_id, AboardReport.magnetometer_id, func.max(AboardReport.id).label("id"))
        .where(*of_reports)
        .group_by(AboardReport.satellite_id, AboardReport.magnetometer_id)
        .subquery()
    )
    place = (newest.c.satellite_id == ParameterSet.satellite_id) & (
        newest.c.magnetometer_id == ParameterSet.magnetometer_id
    )
    rows = session.execute(
        select(
            *(ParameterSet.id, ParameterSet.satellite_id, ParameterSet.magnetometer_id),
            *(AboardReport.parameter_set_id, AboardReport.state),
        )
        .outerjoin(newest, place)
        .outerjoin(AboardReport, AboardReport.id == newest.c.id)
        .where(ParameterSet.status == "active", *of)
        .order_by(ParameterSet.satellite_id, ParameterSet.magnetometer_id)
    )
    found: list[NotAboard] = []
    for set_id, satellite_id, magnetometer_id, reported_id, state in rows:
        is_own = reported_id == set_id
        if not (is_own and state == "confirmed"):
            found.append(NotAboard(set_id, satellite_id, magnetometer_id, state if is_own else None))
    return found


def _read(row: AboardReport) -> AboardRead:
    plain: dict[str, object] = {"state": row.state, "differences": [], "effect_nt": None, "effect_deg": None}
    about = {
        "matches_parameter_set_id": row.matches_parameter_set_id,
        "created_at": row.created_at,
        "created_by": row.created_by,
    }
    return AboardRead.model_validate(plain | (row.comparison or {}) | about)

"""The fleet at a glance: searched, sorted and counted here, so that a page shows a part of thousands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from app.attention.entries import Standing
from app.attention.repository import Acknowledged, AttentionRepository, holds
from app.attention.schemas import (
    FacetsRead,
    FleetPage,
    FleetQuery,
    FleetRow,
    FleetShort,
    FleetShortPage,
    LastFailure,
)
from app.http.paging import in_short

STATES: Final = ("act", "watch", "good")
GRADES: Final = ("refuse", "weak", "accept", None)
FACETS: Final[Mapping[str, Callable[[FleetRow], str]]] = {
    "state": lambda row: row.state,
    "verdict": lambda row: row.verdict or "none",
    "agreement": lambda row: row.agreement or "none",
}
Key = float | str | None


def fleet_page(attention: AttentionRepository, query: FleetQuery) -> FleetPage | FleetShortPage:
    """Return a part of the fleet; each facet is counted within the search and the other facets."""
    standings, known = attention.standings()
    wanted = (query.q or "").casefold().strip()
    rows = [_row(one, known) for one in standings if not wanted or wanted in _searched(one)]
    fitting = [row for row in rows if _fits(row, query)]
    ordered = _ordered(fitting, query.sort)
    begin = int(query.cursor or 0)
    end = begin + query.limit
    items, after = ordered[begin:end], str(end) if end < len(ordered) else None
    total = len(ordered) if query.total else None
    facets = FacetsRead(
        **{
            name: dict(Counter(of(row) for row in rows if _fits(row, query, without=name)))
            for name, of in FACETS.items()
        }
    )
    if query.view == "full":
        return FleetPage(items=items, next=after, total=total, facets=facets)
    short = [in_short(row, FleetShort) for row in items]
    return FleetShortPage(items=short, next=after, total=total, facets=facets)


def _searched(one: Standing) -> str:
    situation = one.situation
    names = (situation.satellite_id, situation.satellite_name, situation.magnetometer_id, situation.norad_id)
    return " ".join(name for name in names if name).casefold()


def _fits(row: FleetRow, query: FleetQuery, without: str | None = None) -> bool:
    asked = {"state": query.state, "verdict": query.verdict, "agreement": query.agreement}
    return all(name == without or wanted is None or FACETS[name](row) == wanted for name, wanted in asked.items())


def _ordered(rows: Sequence[FleetRow], sort: str) -> list[FleetRow]:
    """Return ``rows`` in order; those without a value of it come last, either way round."""
    by_place = sorted(rows, key=lambda row: ((row.name or row.satellite).casefold(), row.satellite, row.magnetometer))
    if sort == "worst":
        return sorted(by_place, key=lambda row: (STATES.index(row.state), -row.attention))
    is_down, name = sort.startswith("-"), sort.removeprefix("-")
    key = SORTS[name]
    there = [row for row in by_place if key(row) is not None]
    return sorted(there, key=lambda row: key(row) or 0, reverse=is_down) + [row for row in by_place if key(row) is None]


SORTS: Final[Mapping[str, Callable[[FleetRow], Key]]] = {
    "name": lambda row: (row.name or row.satellite).casefold(),
    "data_until": lambda row: None if row.data_until is None else row.data_until.timestamp(),
    "residual_nt": lambda row: row.residual_nt,
    "verdict": lambda row: None if row.verdict is None else GRADES.index(row.verdict),
}


def _row(one: Standing, known: Acknowledged) -> FleetRow:
    situation, judged = one.situation, one.situation.judged
    active, session, job = situation.active, situation.session, situation.job
    left = [entry for entry in one.entries if not holds(known, entry)]
    is_act = any(entry.finding.severity == "act" for entry in left)
    values: dict[str, object] = {
        "satellite": situation.satellite_id,
        "name": situation.satellite_name,
        "magnetometer": situation.magnetometer_id,
        "state": "act" if is_act else "watch" if left else "good",
        "attention": len(left),
        "verdict": None if active is None else active.grade,
        "parameter_set_id": None if active is None else active.id,
        "in_force_since": None if active is None else active.begun_at,
        "session_id": None if session is None else session.id,
        "data_until": None if session is None else session.data_until,
        "received_at": situation.received_at,
        "agreement": None if judged is None else judged.grade,
        "residual_nt": None if judged is None else judged.residual_rms_nt,
        "residual_ratio": None if judged is None else judged.residual_ratio,
        "orbit_epoch": None if situation.orbit is None else situation.orbit.epoch,
        "last_failure": None,
        "is_calibrating": situation.is_calibrating,
    }
    if job is not None and job.state == "failed":
        error = job.error or {}
        values["last_failure"] = LastFailure(
            job_id=job.id, code=_text(error.get("code")), detail=_text(error.get("detail")),
            at=job.finished_at or job.created_at,
        )  # fmt: skip
    return FleetRow.model_validate(values)


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None

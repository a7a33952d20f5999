"""The fleet at a glance: searched, sorted and counted here, so that a page shows a part of thousands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from app.attention.entries import Glance, Standing
from app.attention.repository import AttentionRepository
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
GRADES: Final = ("refuse", "weak", "accept")
FACETS: Final = ("state", "verdict", "agreement")
"""In the order in which `Glance.kind` has them."""
Key = float | str | None
Line = tuple[Standing, Glance]


def fleet_page(attention: AttentionRepository, query: FleetQuery) -> FleetPage | FleetShortPage:
    """Return a part of the fleet; each facet is counted within the search and the other facets."""
    view, known = attention.known()
    wanted = (query.q or "").casefold().strip()
    touched = {(row.satellite_id, row.magnetometer_id) for row in known.values()}
    lines = [
        (one, one.glance_of([entry for entry in one.entries if entry.id not in known]) if _place(one) in touched
         else one.glance)
        for one in view.by_name if not wanted or wanted in one.searched
    ]  # fmt: skip
    kinds = Counter(glance.kind for _, glance in lines)
    asked = (query.state, query.verdict, query.agreement)
    fitting = [line for line in lines if _fits(line[1].kind, asked)] if any(asked) else lines
    ordered = _ordered(fitting, query.sort)
    begin = int(query.cursor or 0)
    end = begin + query.limit
    items, after = [_row(*line) for line in ordered[begin:end]], str(end) if end < len(ordered) else None
    total = len(ordered) if query.total else None
    facets = FacetsRead(**{name: _facet(number, kinds, asked) for number, name in enumerate(FACETS)})
    if query.view == "full":
        return FleetPage(items=items, next=after, total=total, facets=facets)
    short = [in_short(row, FleetShort) for row in items]
    return FleetShortPage(items=short, next=after, total=total, facets=facets)


def _place(one: Standing) -> tuple[str, str]:
    return one.situation.satellite_id, one.situation.magnetometer_id


def _fits(kind: Sequence[str], asked: Sequence[str | None], without: int | None = None) -> bool:
    return all(number == without or one is None or one == kind[number] for number, one in enumerate(asked))


def _facet(number: int, kinds: Mapping[tuple[str, str, str], int], asked: Sequence[str | None]) -> dict[str, int]:
    """Return how many magnetometers there are of each value of a facet, among those that fit the other facets."""
    found: Counter[str] = Counter()
    for kind, count in kinds.items():
        if _fits(kind, asked, without=number):
            found[kind[number]] += count
    return dict(found)


def _ordered(lines: Sequence[Line], sort: str) -> Sequence[Line]:
    """Return ``lines``, which are in the order of names, in that of ``sort``; without a value of it they come last."""
    if sort == "worst":
        return sorted(lines, key=lambda line: (STATES.index(line[1].state), -line[1].attention))
    is_down, name = sort.startswith("-"), sort.removeprefix("-")
    key = SORTS[name]
    keyed = [(key(one), (one, glance)) for one, glance in lines]
    there = sorted((one for one in keyed if one[0] is not None), key=lambda one: one[0] or 0, reverse=is_down)
    return [line for _, line in there] + [line for value, line in keyed if value is None]


SORTS: Final[Mapping[str, Callable[[Standing], Key]]] = {
    "name": lambda one: one.name_order[0],
    "data_until": lambda one: None if one.situation.session is None else one.situation.session.data_until.timestamp(),
    "residual_nt": lambda one: None if one.situation.judged is None else one.situation.judged.residual_rms_nt,
    "verdict": lambda one: None if one.situation.active is None else GRADES.index(one.situation.active.grade),
}


def _row(one: Standing, glance: Glance) -> FleetRow:
    situation, judged = one.situation, one.situation.judged
    active, session, job = situation.active, situation.session, situation.job
    values: dict[str, object] = {
        "satellite": situation.satellite_id,
        "name": situation.satellite_name,
        "magnetometer": situation.magnetometer_id,
        "state": glance.state,
        "attention": glance.attention,
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

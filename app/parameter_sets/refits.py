"""HTTP of refits: a fit made again from the moments that it left, without its telemetry."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final

from fastapi import APIRouter, Query
from pydantic import Field

from app.access.authentication import Reader
from app.access.caller import Caller
from app.errors import NoMomentsError
from app.http.concurrency import Places
from app.http.dependencies import Blobs, Db
from app.http.schemas import Filter, Record
from app.http.strict_json import StrictJsonRoute
from app.parameter_sets.repository import ParameterSetRepository
from app.parameter_sets.schemas import ParametersRead
from app.records.json_numbers import without_nan
from app.storage.store import Store, moments_key
from magcal_core.errors import InputError, MomentsError
from magcal_core.telemetry.spans import MOST_SPANS, Span, parse_span

if TYPE_CHECKING:
    from magcal_core.calibration.refit.moments import FitMoments
    from magcal_core.calibration.refit.outcome import RefitOptions

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])

MOST_REPLICATES: Final = 10_000
LARGEST_SEED: Final = 2**63 - 1
PLACES: Final = Places("refits")
"""The most replicates take half a second of a core and 300 MiB."""
AT_HAND: Final = 8
"""Moments that a process keeps decoded: whoever asks once mostly asks again."""


class RefitQuery(Filter):
    """What is to be different from the fit of the parameter set."""

    regressors: str | None = Field(
        None,
        max_length=2000,
        description="Columns that move the bias, with commas between; empty for none; `auto` for those that unseen "
        "blocks of time bear out. Unset: those of the set.",
    )
    time_offset: bool | None = Field(
        None, description="Whether the offset of the telemetry's clock is an unknown. Unset: as in the set."
    )
    without: list[str] = Field(
        default_factory=list,
        max_length=MOST_SPANS,
        description="Spans of time to leave out, each FROM/UNTIL in ISO 8601 with Z, such as "
        "2026-11-22T10:00:00Z/2026-11-22T10:05:00Z; to within the length of a block, of which there are "
        "96 at most and 24 where many columns are kept.",
    )
    bootstrap: int = Field(
        0, ge=0, le=MOST_REPLICATES, description="Replicates of a bootstrap over blocks of time; 0 for none."
    )
    seed: int = Field(0, ge=0, le=LARGEST_SEED, description="Of the bootstrap: the same seed, the same replicates.")


class ParameterChangeRead(Record):
    """One parameter in the set and in the refit; a regressor that one of them lacks is zero there."""

    parameter: str = Field(description="As in `parameter_names` of the set.")
    before: float | None = Field(description="In the set.")
    after: float | None = Field(description="In the refit.")
    standard_error: float | None = Field(description="Of the refit, under correlated residuals.")


class RefitModelRead(Record):
    """One model that was tried: what it leaves in the refit and on unseen blocks of time."""

    name: str
    regressors: list[str]
    parameters: int = Field(description="How many unknowns it has, the clock not counted.")
    rms_nt: float | None
    cross_validated_rms_nt: float | None = Field(
        description="Residual on unseen blocks, nT; null where a part of the data does not determine it."
    )
    cost: float | None = Field(description="Weighted sum of squares, nT^2.")
    log_evidence: float | None = Field(description="Null where unseen blocks decide instead of the evidence.")
    surrogate_max: float | None = Field(description="Null likewise.")
    selected: bool


class RefitClockRead(Record):
    """The clock's offset: what has to be added to the telemetry's time."""

    offset_s: float | None
    standard_error_s: float | None
    p_value: float | None = Field(description="Probability of an offset so large where there is none.")
    is_significant: bool
    detectable_s: float | None = Field(description="Offset that data like these would show.")


class RefitBootstrapRead(Record):
    """Scatter of the refit over blocks of time drawn with replacement."""

    replicates: int
    failed: int = Field(description="Replicates that did not determine the parameters.")
    block_samples: int
    standard_errors: ParametersRead
    low: ParametersRead = Field(description="Lower end of the middle 95 %.")
    high: ParametersRead = Field(description="Upper end of the middle 95 %.")


class RefitRead(Record):
    """A refit: one Gauss-Newton step from the set's fit, under the weights that the fit gave the samples.

    It is exact where the residual is linear in the unknowns, and near the fit it hardly bends. A calibration by a new
    job weighs the samples anew and takes every step; it is what makes a set that can be put in force.
    """

    parameter_set_id: str
    parameters: ParametersRead
    standard_errors: ParametersRead = Field(
        description="As a new calibration has them: under correlated residuals, beside errors locked to the orbit, and "
        "with errors of the reference."
    )
    changes: list[ParameterChangeRead]
    rms_nt: float | None = Field(description="Residual of the refit, weighted, nT.")
    cross_validated_rms_nt: float | None = Field(
        description="Residual on six spans of time, each left out in turn, nT; null where the rest tells too little."
    )
    samples: int = Field(description="That the refit rests on.")
    blocks: int = Field(description="Of time, that the standard errors rest on.")
    left_out_share: float = Field(description="Share of the data that `without` took, 0 to 1.")
    ablation: list[RefitModelRead] = Field(description="Models that were tried, one of them selected.")
    time_offset: RefitClockRead | None = Field(description="Null where the clock is no unknown.")
    bootstrap: RefitBootstrapRead | None = Field(description="Null where none was asked for.")
    warnings: list[str] = Field(
        description="What the standard errors do not contain: `hidden_errors_not_kept` for a set from before moments "
        "had errors locked to the orbit and errors of the reference, `clock_held` where its clock stays as it is."
    )


@router.get("/{parameter_set_id}/refit")
def get_refit(
    parameter_set_id: str, query: Annotated[RefitQuery, Query()], caller: Reader, db: Db, store: Blobs
) -> RefitRead:
    """Fit anew from the moments that the fit left: one Gauss-Newton step under its weights; nothing is stored."""
    from magcal_core.calibration.refit.refit import refit

    options, moments = _options(query), moments_of_set(parameter_set_id, caller, db, store)
    with PLACES.one():
        found = refit(moments, options).to_dict()
    return RefitRead.model_validate(without_nan(found | {"parameter_set_id": parameter_set_id}))


def _options(query: RefitQuery) -> RefitOptions:
    from magcal_core.calibration.refit.outcome import RefitOptions

    asked = query.regressors
    names = None if asked is None else tuple(dict.fromkeys(name for one in asked.split(",") if (name := one.strip())))
    return RefitOptions(
        regressors="auto" if names == ("auto",) else names,
        time_offset=query.time_offset,
        without=tuple(_span(one) for one in query.without),
        bootstrap=query.bootstrap,
        seed=query.seed,
    )


def _span(text: str) -> Span:
    try:
        return parse_span(text)
    except InputError as error:
        error.message = f"without: {error.message}"
        raise


def moments_of_set(parameter_set_id: str, caller: Caller, db: Db, store: Store) -> FitMoments:
    """Return the moments of a parameter set that the caller reaches.

    Raises
    ------
    NoMomentsError
        The set is from before moments were kept, or from a method that leaves none.
    """
    with db.read() as session:
        sha256 = ParameterSetRepository(session, caller).moments_sha256(parameter_set_id)
        if sha256 is None:
            raise NoMomentsError("the parameter set has no moments: its method leaves none, or it is from before them")
        content = store.get(session, moments_key(parameter_set_id), sha256)
    try:
        return _decoded(sha256, content)
    except MomentsError as error:
        raise NoMomentsError(f"the moments cannot be used by this version: {error}; calibrate again") from error


@lru_cache(maxsize=AT_HAND)
def _decoded(_sha256: str, content: bytes) -> FitMoments:
    from magcal_core.calibration.refit.moments import FitMoments

    return FitMoments.from_bytes(content)

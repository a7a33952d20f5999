"""HTTP of the bias inside a session: its path and its steps, from the moments that the fit left."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter
from pydantic import Field

from app.access.authentication import Reader
from app.access.caller import Caller
from app.http.concurrency import Places
from app.http.dependencies import Blobs, Db
from app.http.schemas import Record, UtcTime
from app.http.strict_json import StrictJsonRoute
from app.parameter_sets.refits import AT_HAND, moments_of_set
from app.storage.store import Store

if TYPE_CHECKING:
    from magcal_core.calibration.refit.moments import FitMoments
    from magcal_core.calibration.terms.bias_path import BiasPath

router = APIRouter(route_class=StrictJsonRoute, prefix="/parameter-sets", tags=["parameter sets"])

PLACES: Final = Places("bias paths")


class BiasStepRead(Record):
    """A step of the bias: after less before."""

    time: UtcTime
    from_: UtcTime = Field(alias="from", description="First time that is as likely.")
    until: UtcTime = Field(description="Last time that is as likely.")
    change_nt: list[float]
    standard_errors_nt: list[float]
    statistic: float = Field(description="Believed above 25.")
    text: str


class BiasPathRead(Record):
    """The bias over the data of a parameter set, which itself has one value for all of it."""

    parameter_set_id: str
    time: list[UtcTime] = Field(description="Middle of each block of time.")
    bias_nt: list[list[float]] = Field(description="Bias, sensor frame, nT: one row a block, three axes.")
    standard_errors_nt: list[list[float]]
    steps: list[BiasStepRead]


@router.get("/{parameter_set_id}/bias-path")
def get_bias_path(parameter_set_id: str, caller: Reader, db: Db, store: Blobs) -> BiasPathRead:
    """Give the path of the bias over a set's data, with errors and steps, from the moments of its fit."""
    found = path_of_set(parameter_set_id, caller, db, store).to_dict()
    return BiasPathRead.model_validate(found | {"parameter_set_id": parameter_set_id})


def path_of_set(parameter_set_id: str, caller: Caller, db: Db, store: Store) -> BiasPath:
    """Return the path of the bias of a parameter set that the caller reaches.

    Raises
    ------
    NoMomentsError
        The set has no moments that can be used.
    """
    moments = moments_of_set(parameter_set_id, caller, db, store)
    with PLACES.one():
        return _path(_Moments(moments))


class _Moments:
    """Moments that the cache knows by what they are: those at hand are the same object."""

    def __init__(self, moments: FitMoments) -> None:
        self.moments = moments

    def __hash__(self) -> int:
        return id(self.moments)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Moments) and other.moments is self.moments


@lru_cache(maxsize=AT_HAND)
def _path(kept: _Moments) -> BiasPath:
    from magcal_core.calibration.terms.bias_path import bias_path

    return bias_path(kept.moments)

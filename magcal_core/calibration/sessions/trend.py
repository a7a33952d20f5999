"""Parameters across sessions: where they are between sets and now, how sure that is, and how long a set lives.

Notes
-----
A trend is made from stored parameter sets, no telemetry is read. Each group of three (bias, scale factors, angles) is a
random walk with scatter from session to session (`trend_filter`); walk and scatter are not one best value but a grid,
weighed by likelihood and prior; jumps and sets that the others disown are looked for beside it (`trend_changes`).
`docs/time.md` has the figures that it was chosen by.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

import numpy as np

from magcal_core.arrays import Floats, Times
from magcal_core.calibration.sessions.trend_changes import (
    FEWEST_FOR_CHANGES,
    SIGNIFICANT_P,
    explain,
    p_value_of_last,
    without_last,
)
from magcal_core.calibration.sessions.trend_filter import History
from magcal_core.calibration.sessions.trend_life import (
    DAYS_A_YEAR,
    Life,
    life_text,
    life_years,
    years_within,
)
from magcal_core.calibration.sessions.trend_sets import Chosen, DatedSet, HasRecord, choose_sets
from magcal_core.calibration.sessions.trend_states import NAMES, NS_A_YEAR, Smoothed, TrendStates
from magcal_core.errors import BeyondHistoryError, InputError, OptionError, TimeError
from magcal_core.sensor.parameters import GROUPS, Parameters
from magcal_core.telemetry.iso_times import parse_iso_time
from magcal_core.units import utc_text

Moment = str | datetime | np.datetime64

BIAS_UNIT_NT: Final = 40_000.0
_SPANS_BEYOND: Final = 3.0
_LEAST_BEYOND_YEARS: Final = 3.0 / DAYS_A_YEAR
_ERRATIC_WALK: Final = 0.1
_ERRATIC_YEARS: Final = 30.0 / DAYS_A_YEAR


@dataclass(frozen=True, slots=True)
class TrendJump:
    """A change of one group between two sets; never a moment, nobody was there."""

    group: str
    from_set: str
    until_set: str
    begin: np.datetime64
    end: np.datetime64
    change: tuple[float, ...]
    standard_errors: tuple[float, ...]
    p_value: float

    @property
    def text(self) -> str:
        """The jump in words."""
        told = ", ".join(f"{c:+.4g} +- {e:.2g}" for c, e in zip(self.change, self.standard_errors, strict=True))
        return f"{self.group} changed by {told} between {self.from_set} and {self.until_set}"

    def to_dict(self) -> dict[str, object]:
        """Return the jump as the trend's record has it."""
        return {
            "group": self.group,
            "from_set": self.from_set,
            "until_set": self.until_set,
            "from": utc_text(self.begin),
            "until": utc_text(self.end),
            "change": list(self.change),
            "standard_errors": list(self.standard_errors),
            "p_value": self.p_value,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """The history of one magnetometer's parameters; `to_dict` gives the record.

    Attributes
    ----------
    at_utc : the time that the record is given for.
    share, field_nt : of the life: share of the field, nT, that the error's bound may not pass.
    chosen : the sets, those left out with reasons.
    smoothed : the history.
    without_last : the same without the last set, where that is unconfirmed.
    p_value_of_last : None where there are too few sets to ask.
    left_out : tuple of (label, reason).
    """

    at_utc: np.datetime64
    share: float
    field_nt: float
    chosen: Chosen
    smoothed: Smoothed
    without_last: Smoothed | None
    p_value_of_last: float | None
    left_out: tuple[tuple[str, str], ...]

    @property
    def sets(self) -> tuple[DatedSet, ...]:
        """The sets that count, outliers taken away, in the order of time."""
        return tuple(self.chosen.sets[i] for i in self.smoothed.explained.kept)

    @property
    def walk(self) -> dict[str, float]:
        """Root of the posterior mean square of each group's walk, share per root year."""
        return _by_group(self.smoothed.explained.mean_squares()[0])

    @property
    def scatter(self) -> dict[str, float]:
        """Root of the posterior mean square of each group's scatter from session to session, share."""
        return _by_group(self.smoothed.explained.mean_squares()[1])

    @property
    def status(self) -> str:
        """``ok``, or ``erratic``: sets that bad are failed calibrations, not a sensor."""
        is_long = self.smoothed.span_years >= _ERRATIC_YEARS
        return "erratic" if is_long and max(self.walk.values()) > _ERRATIC_WALK else "ok"

    @property
    def jumps(self) -> tuple[TrendJump, ...]:
        """The jumps, in the order of time."""
        found = sorted(self.smoothed.explained.jumps, key=lambda one: (one.interval, one.group))
        return tuple(self._jump(one.group, one.interval, one.p_value) for one in found)

    def at(self, t_utc: Moment | Times) -> TrendStates:
        """Return the sensor's state at a time, or at several, UTC.

        Raises
        ------
        TimeError
            No time.
        BeyondHistoryError
            More than three spans of the history (at least 3 d) outside it.
        """
        if isinstance(t_utc, np.ndarray) and t_utc.ndim:
            times = t_utc.astype("datetime64[ns]")
            if np.isnat(times).any():
                raise TimeError("at: a time is missing")
            self._require_near(times)
            return self.smoothed.at(times)
        times = np.array([_moment(t_utc)])
        self._require_near(times)
        return self.smoothed.at(times).one(0)

    def life(self, parameters: Parameters | Mapping[str, object] | Floats | None = None) -> Life:
        """Return how long a set with these parameters stays good; that of the active set unless given."""
        label = self.chosen.active.label if parameters is None else None
        values = self.chosen.active.parameters if parameters is None else _nine(parameters)
        why = self._why_no_life()
        if why:
            return Life(
                label, self.share, None, False, None, life_text(None, self.share, is_capped=False, why_none=why)
            )
        begin, years, bounds = self.bounds(values)
        left, is_capped = years_within(years, bounds, self.share * self.field_nt)
        end = self.smoothed.time_of(begin + left)
        days = left * DAYS_A_YEAR
        text = life_text(days, self.share, is_capped=is_capped, why_none="")
        return Life(label, self.share, days, is_capped, utc_text(end), text)

    def error_bound_nt(self, parameters: Parameters | Mapping[str, object] | Floats, t_utc: Moment) -> float:
        """Return the bound that the field's error of a set with these parameters keeps at a time, nT."""
        times = np.array([_moment(t_utc)])
        self._require_near(times)
        return float(self.smoothed.bounds_nt(_nine(parameters), self.smoothed.years_of(times))[0])

    def bounds(self, parameters: Floats) -> tuple[float, Floats, Floats]:
        """Return when a life is counted from, years, and times from there with the bound of the field's error, nT."""
        begin = max(float(self.smoothed.years_of(np.array([self.at_utc]))[0]), self._last_years())
        years = life_years(self.smoothed.span_years)
        return begin, years, self.smoothed.bounds_nt(parameters, begin + years)

    def to_dict(self) -> dict[str, object]:
        """Return the trend as the service answers it."""
        now, sets, first = self.at(self.at_utc), self.sets, self.sets[0]
        return {
            "satellite": first.owner[0] or None,
            "magnetometer": first.owner[1] or None,
            "at": utc_text(self.at_utc),
            "status": self.status,
            "sets": len(sets),
            "since": utc_text(np.datetime64(sets[0].from_ns, "ns")),
            "until": utc_text(np.datetime64(max(one.until_ns for one in sets), "ns")),
            "parameters": _record(now.parameters),
            "standard_errors": _record(now.standard_errors),
            "parameter_names": list(NAMES),
            "covariance": now.covariance.tolist(),
            "field_error_nt": float(now.field_error_nt),
            "walk": self.walk,
            "scatter": self.scatter,
            "jumps": [jump.to_dict() for jump in self.jumps],
            "left_out": [{"parameter_set_id": label, "reason": reason} for label, reason in self.left_out],
            "warnings": self._warnings(),
            "unconfirmed": self._unconfirmed(),
            "life": self.life().to_dict(),
        }

    def _why_no_life(self) -> str:
        if self.without_last is not None:
            return "the last set is far from what the others forecast; one more session decides"
        if self.status == "erratic":
            return "the sets differ too much to be those of one sensor"
        return ""

    def _last_years(self) -> float:
        return float(self.smoothed.explained.history.years[-1])

    def _require_near(self, t_utc: Times) -> None:
        history = self.smoothed.explained.history
        years, reach = self.smoothed.years_of(t_utc), max(_SPANS_BEYOND * self.smoothed.span_years, _LEAST_BEYOND_YEARS)
        far = np.maximum(years - history.years[-1], history.years[0] - years)
        if float(far.max(initial=0.0)) > reach:
            text = utc_text(t_utc[int(far.argmax())])
            raise BeyondHistoryError(
                f"at: {text} is {far.max() * DAYS_A_YEAR:.0f} d outside the history of the sets, limit "
                f"{reach * DAYS_A_YEAR:.0f} d (three times its span)"
            )

    def _jump(self, group: int, interval: int, p_value: float) -> TrendJump:
        of, history = slice(3 * group, 3 * group + 3), self.smoothed.explained.history
        times = history.years[interval : interval + 2]
        means, covariances = self.smoothed.shares_at(times)
        change = means[1, of] - means[0, of]
        walked = (times[1] - times[0]) * self.smoothed.whole.walks[of]
        spread = np.diagonal(covariances, axis1=1, axis2=2)[:, of].sum(axis=0) + walked
        unit, sets = self.smoothed.unit[of], self.sets
        first, second = sets[interval], sets[interval + 1]
        return TrendJump(
            GROUPS[group],
            first.label,
            second.label,
            np.datetime64(first.time_ns, "ns"),
            np.datetime64(second.time_ns, "ns"),
            tuple((change * unit).tolist()),
            tuple((np.sqrt(spread) * unit).tolist()),
            p_value,
        )

    def _warnings(self) -> list[str]:
        found = []
        if len(self.chosen.sets) < FEWEST_FOR_CHANGES:
            count = len(self.chosen.sets)
            found.append(f"few_sets: {count} sets, jumps and outliers are looked for from {FEWEST_FOR_CHANGES} on")
        if self.status == "erratic":
            walk = max(self.walk.values())
            found.append(
                f"erratic: the sets walk by {walk:.2g} per root year, limit {_ERRATIC_WALK:g}: failed calibrations"
            )
        if self.without_last is not None:
            found.append(
                "unconfirmed: the last set is far from what the others forecast: a jump, or a bad set; one more decides"
            )
        return found

    def _unconfirmed(self) -> dict[str, object] | None:
        if self.without_last is None:
            return None
        without = self.without_last.at(np.array([self.at_utc])).one(0)
        return {
            "parameter_set_id": self.sets[-1].label,
            "p_value": self.p_value_of_last,
            "without": {
                "parameters": _record(without.parameters),
                "standard_errors": _record(without.standard_errors),
            },
        }


def trend(
    sets: Iterable[Mapping[str, object] | HasRecord],
    at: Moment | None = None,
    share: float = 0.01,
    field_nt: float = 40_000.0,
) -> Trend:
    """Return the trend of one magnetometer's parameter sets, in any order.

    Parameters
    ----------
    sets : records of parameter sets, or calibrations.
    at : time that the record is given for; the end of the last set's data unless given.
    share, field_nt : of the life: the share of the field, nT, that the error's bound may not pass.

    Raises
    ------
    TooFewSetsError
        Fewer than three sets count.
    OptionError
        A share or a field that cannot be, sets of several magnetometers, a set without a usable covariance.
    BeyondHistoryError, TimeError
        ``at`` is too far outside the history, or no time.
    InputError
        A record is no parameter set.
    """
    if not (np.isfinite(share) and 0.0 < share <= 1.0):
        raise OptionError(f"share: {share:g}, want a number above 0, 1 at most")
    if not (np.isfinite(field_nt) and 100.0 <= field_nt <= 1e6):
        raise OptionError(f"field_nt: {field_nt:g}, want a number from 100 to 1,000,000 nT")
    chosen = choose_sets(sets)
    at_utc = np.datetime64(max(one.until_ns for one in chosen.every), "ns") if at is None else _moment(at)
    history, centre, unit = _history(chosen.sets)
    explained = explain(history)
    gone = set(range(len(history))) - set(explained.kept.tolist())
    left_out = (*chosen.left_out, *((chosen.sets[i].label, "outlier") for i in sorted(gone)))
    made = (centre, unit, field_nt, chosen.sets[0].time_ns)
    p_value, others = None, None
    if len(explained.history) >= FEWEST_FOR_CHANGES:
        others = without_last(explained)
        p_value = p_value_of_last(explained, others)
    is_unconfirmed = others is not None and p_value is not None and p_value < SIGNIFICANT_P
    without = Smoothed.of(others, *made) if others is not None and is_unconfirmed else None
    found = Trend(
        at_utc, share, field_nt, chosen, Smoothed.of(explained, *made), without, p_value, tuple(sorted(left_out))
    )
    found._require_near(np.array([at_utc]))
    return found


def _history(sets: tuple[DatedSet, ...]) -> tuple[History, Floats, Floats]:
    """Return the history in shares less its median, with that median and the unit of a share, shape (9,) both."""
    values = np.array([one.parameters for one in sets])
    centre = np.median(values, axis=0)
    if not centre[3:6].all():
        raise InputError("the scale factors of the sets have no median: signs differ")
    unit = np.concatenate([np.full(3, BIAS_UNIT_NT), np.abs(centre[3:6]), np.full(3, np.rad2deg(1.0))])
    covariances = np.array([one.covariance for one in sets]) / np.outer(unit, unit)
    times = np.array([one.time_ns for one in sets], np.int64)
    return History((times - times[0]) / NS_A_YEAR, (values - centre) / unit, covariances), centre, unit


def _moment(value: Moment | Times) -> np.datetime64:
    """Return a time, ns UTC, from ISO 8601 text with a zone, an aware datetime or a datetime64 in UTC."""
    if isinstance(value, str):
        return parse_iso_time(value)
    if isinstance(value, datetime):
        if value.tzinfo is None:
            raise TimeError("at: the time has no zone")
        return np.datetime64(value.astimezone(UTC).replace(tzinfo=None), "ns")
    moment = np.asarray(value)
    if moment.dtype.kind != "M" or moment.ndim or np.isnat(moment):
        raise TimeError("at: this is no time")
    return np.datetime64(int(moment.astype("datetime64[ns]").astype(np.int64)), "ns")


def _nine(parameters: Parameters | Mapping[str, object] | Floats) -> Floats:
    """Return nine parameters in the order of `NAMES`."""
    if isinstance(parameters, Parameters):
        return parameters.vector[:9]
    try:
        told = parameters
        if isinstance(told, Mapping):
            groups = told.get("parameters", told)
            told = np.array([v for group in GROUPS for v in groups[group]], np.float64)  # type: ignore[index]
        values = np.asarray(told, np.float64)[:9]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"these are no parameters: {error}") from error
    if values.shape != (9,) or not np.isfinite(values).all():
        raise InputError("these are no parameters: nine numbers are wanted")
    return values


def _by_group(mean_squares: Floats) -> dict[str, float]:
    return dict(zip(GROUPS, np.sqrt(mean_squares).tolist(), strict=True))


def _record(values: Floats) -> dict[str, object]:
    """Return nine values as a record has parameters."""
    groups: dict[str, object] = {group: values[3 * i : 3 * i + 3].tolist() for i, group in enumerate(GROUPS)}
    return groups | {"time_offset_s": None, "regressors": {}}

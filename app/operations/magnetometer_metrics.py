"""Each magnetometer as Prometheus is told of it: verdict, ages, residual, what needs attention; bounded in number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from typing import Final

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app.access.caller import Caller
from app.attention.entries import Fleet, Standing
from app.storage.database import Database, utc_now

PLACE: Final = ("satellite", "magnetometer")
GRADES: Final = {"accept": 2.0, "weak": 1.0, "refuse": 0.0}
AGREEMENTS: Final = {"agrees": 2.0, "watch": 1.0, "disagrees": 0.0}
Reading = Callable[[Standing, datetime], float | None]


def _age(since: datetime | None, now: datetime) -> float | None:
    return None if since is None else (now - since).total_seconds()


def _residual_ratio(one: Standing, _now: datetime) -> float | None:
    return None if one.situation.judged is None else one.situation.judged.residual_ratio


def _verdict(one: Standing, _now: datetime) -> float:
    return -1.0 if one.situation.active is None else GRADES[one.situation.active.grade]


def _agreement(one: Standing, _now: datetime) -> float | None:
    judged = one.situation.judged
    return None if judged is None or judged.grade is None else AGREEMENTS.get(judged.grade)


def _data_age(one: Standing, now: datetime) -> float | None:
    return _age(None if one.situation.session is None else one.situation.session.data_until, now)


def _orbit_age(one: Standing, now: datetime) -> float | None:
    orbit = one.situation.orbit
    return _age(None if orbit is None else orbit.until or orbit.epoch, now)


def _set_age(one: Standing, now: datetime) -> float | None:
    return _age(None if one.situation.active is None else one.situation.active.data_until, now)


READINGS: Final[Mapping[str, tuple[str, Reading]]] = {
    "magcal_magnetometer_verdict": ("Of the set in force: 2 accept, 1 weak, 0 refuse, -1 none.", _verdict),
    "magcal_magnetometer_agreement": (
        "Of the newest session with the set in force: 2 agrees, 1 watch, 0 disagrees.", _agreement,
    ),
    "magcal_magnetometer_residual_ratio": (
        "Residual of the newest session under the set in force over that of the set.", _residual_ratio,
    ),
    "magcal_magnetometer_data_age_seconds": ("Age of the newest reading, s.", _data_age),
    "magcal_magnetometer_orbit_age_seconds": ("Age of the newest orbit, s; below 0 if it reaches ahead.", _orbit_age),
    "magcal_magnetometer_set_age_seconds": ("Age of the newest data of the set in force, s.", _set_age),
}  # fmt: skip


class MagnetometerState(Collector):
    """The gauges of each magnetometer, the worst ``most`` of them; a registry asks for them when it is read."""

    def __init__(self, database: Database, fleet: Fleet, caller: Caller, most: int) -> None:
        self._database = database
        self._fleet = fleet
        self._caller = caller
        self._most = most

    def collect(self) -> Iterator[Metric]:
        """Yield the gauges."""
        with self._database.read() as session:
            every = self._fleet.view(session, self._caller).standings
        shown, now = sorted(every, key=_rank)[: self._most], utc_now()
        yield GaugeMetricFamily("magcal_magnetometers", "Magnetometers there are.", value=len(every))
        yield GaugeMetricFamily("magcal_magnetometers_left_out", "Told of by no metric.", value=len(every) - len(shown))
        for name, (text, reading) in READINGS.items():
            gauge = GaugeMetricFamily(name, text, labels=PLACE)
            for one in shown:
                value = reading(one, now)
                if value is not None:
                    gauge.add_metric(_place(one), value)
            yield gauge
        needs = GaugeMetricFamily(
            "magcal_attention", "Entries that need attention, acknowledged or not.", labels=(*PLACE, "code", "severity")
        )
        for one in shown:
            for entry in one.entries:
                needs.add_metric([*_place(one), entry.code, str(entry.finding.severity)], 1.0)
        yield needs


def _place(one: Standing) -> list[str]:
    return [one.situation.satellite_id, one.situation.magnetometer_id]


def _rank(one: Standing) -> tuple[int, int, str, str]:
    urgent = sum(entry.finding.severity == "act" for entry in one.entries)
    return -urgent, -len(one.entries), one.situation.satellite_id, one.situation.magnetometer_id

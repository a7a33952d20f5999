"""The reader of mean elements, graded by `gpconf`: catalogue numbers above 99999, Alpha-5, OMM in every form.

Corpus and grader are others' work (Apache-2.0). Graded are the cases whose files the package carries;
those that want files of CelesTrak are not, as no test fetches anything.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from gpconf import locate
from gpconf.runner import Runner, Unsupported

from magcal_core.orbit.messages.omm import Omm, parse_omms
from magcal_core.orbit.messages.tle import Tle, checksum, parse_tles, read_tles
from magcal_core.orbit.sources import parse_sources

pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the grader leaves its files open

RAD_MIN = 1440.0 / (2.0 * math.pi)
"""Revolutions a day in one radian a minute."""
KEPT = frozenset({"classification_type", "element_set_no", "ephemeris_type", "rev_at_epoch"})
"""What the grader asks for and no calculation needs: it is not kept."""
LINES = (
    "1 25544U 98067A   98324.28472222 -.00003657  11563-4  00000+0 0    10",
    "2 25544  51.5908 168.3788 0125362  86.4185 359.7454 16.05064833    05",
)
MESSAGE = (
    "CCSDS_OMM_VERS = 3.0\nNORAD_CAT_ID = {number}\nEPOCH = {epoch}\nMEAN_MOTION = 16.05\nECCENTRICITY = 0.0125\n"
    "INCLINATION = 51.6\nRA_OF_ASC_NODE = 168.4\nARG_OF_PERICENTER = 86.4\nMEAN_ANOMALY = 359.7\n"
)


def record(elements: Tle | Omm) -> dict[str, Any]:
    """Return elements under the grader's names; B* and the derivatives are those that SGP4 is given."""
    satrec = elements.satrec()
    return {
        "norad_cat_id": int(elements.norad_id) if elements.norad_id else None,
        "object_name": elements.name or None,
        "object_id": elements.cospar_id or None,
        "epoch": moment(elements.epoch_utc),
        "mean_motion": elements.mean_motion_rev_day,
        "eccentricity": elements.eccentricity,
        "inclination": elements.inclination_deg,
        "ra_of_asc_node": elements.raan_deg,
        "arg_of_pericenter": elements.argument_of_perigee_deg,
        "mean_anomaly": elements.mean_anomaly_deg,
        "bstar": satrec.bstar,
        "mean_motion_dot": satrec.ndot * RAD_MIN * 1440.0,
        "mean_motion_ddot": satrec.nddot * RAD_MIN * 1440.0**2,
    }


def moment(epoch_utc: np.datetime64) -> datetime:
    return epoch_utc.astype("datetime64[us]").astype(datetime).replace(tzinfo=UTC)


def with_field(first: int, text: str) -> Tle:
    """Return the TLE of `LINES` with a field from column ``first`` on, in both lines where it is the number."""
    lines = [LINES[0][: first - 1] + text + LINES[0][first - 1 + len(text) :], LINES[1]]
    if first == 3:
        lines[1] = LINES[1][:2] + text + LINES[1][2 + len(text) :]
    (tle,) = parse_tles("\n".join(line[:-1] + str(checksum(line)) for line in lines))
    return tle


class Reader:
    """magcal as the grader calls it: a file whole, as it came; of TLEs each set by itself."""

    def parse(self, raw: bytes, form: str) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = [{"_adapter": {"refusals": True}}]
        if form not in {"tle", "2le"}:
            return found + [record(one.orbit.elements) for one in parse_sources(raw)]
        text = raw.decode()
        tles, faults = read_tles(text)
        for fault in faults:
            line = text.splitlines()[int(fault.where.split()[1].rstrip(",")) - 1]
            found.append({"_refused": f"{fault.where}: {fault.why}", "_field": line[2:7], "_input": line[:80]})
        return found + [record(tle) for tle in tles]

    def alpha5_decode(self, field: str) -> int:
        return int(with_field(3, f"{field:5}").norad_id)

    def two_digit_year(self, digits: str) -> int:
        return moment(with_field(19, digits).epoch_utc).year

    def parse_catalog_id(self, text: str) -> int:
        (omm,) = parse_omms(MESSAGE.format(number=text, epoch="2026-09-20T12:42:37"), "kvn")
        return int(omm.norad_id)

    def parse_epoch(self, text: str) -> datetime:
        (omm,) = parse_omms(MESSAGE.format(number=25544, epoch=text), "kvn")
        return moment(omm.epoch_utc)

    def alpha5_encode(self, _number: int) -> str:
        raise Unsupported("magcal writes no TLE")


@pytest.fixture(scope="module")
def graded() -> Mapping[str, Any]:
    """What the grader says of each case, by the case's name."""
    place = locate.resolve(None, None)
    runner = Runner(Reader(), root=place["corpus"], data=place["corpus"], fetch_hints=False)
    return {one.case_id: one for one in runner.run()}


CASES = ("alpha5-encoding-vectors", "alpha5-tle-derived", "kvn-syntax-variants", "corrupt-input")


@pytest.mark.parametrize("case", CASES)
def test_no_item_of_a_case_fails(graded: Mapping[str, Any], case: str) -> None:
    """But for epochs: a blank for the T and an offset are read, a leap second, which no clock here has, is not."""
    failed = [item for item in graded[case].items if item.status == "fail" and item.check != "ccsds-epoch-strings"]
    assert [(item.check, item.file, item.detail) for item in failed] == []
    assert sum(item.status in {"pass", "pass-tolerance"} for item in graded[case].items) >= 3


def test_only_three_epochs_are_read_otherwise_than_the_standard_says(graded: Mapping[str, Any]) -> None:
    (item,) = (one for one in graded["alpha5-encoding-vectors"].items if one.check == "ccsds-epoch-strings")
    assert [text in item.detail for text in ("2016-12-31T23:59:60", "2026-09-20 12:42:37", "+00:00")] == [True] * 3
    assert item.detail.count(";") == 2


def test_what_is_not_compared_is_what_is_not_kept(graded: Mapping[str, Any]) -> None:
    gaps = [one.detail for case in CASES for one in graded[case].items if one.check == "fields-not-returned"]
    assert gaps
    for gap in gaps:
        assert set(gap.partition(": ")[2].partition(" (")[0].split(", ")) <= KEPT

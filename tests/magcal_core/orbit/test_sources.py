"""Orbits are recognised by what they contain, whatever they are called."""

import json
from pathlib import Path

import numpy as np
import pytest

from magcal_core.errors import EncodingError, OrbitFormatError, TleChecksumError, TleFormatError
from magcal_core.orbit.sources import parse_orbits, parse_sources

STATE = {
    "epoch": "2022-02-19T22:37:44.130Z",
    "frame": "GCRF",
    "position_km": [6861.897826, -934.3811016, -14.66851920],
    "velocity_km_s": [-0.1222573311, -1.009655310, 7.525523775],
}
OMM = {
    "OBJECT_NAME": "BRO-4",
    "EPOCH": "2021-09-23T05:32:45.214368",
    "MEAN_MOTION": 15.08183038,
    "ECCENTRICITY": 0.0031328,
    "INCLINATION": 97.5553,
    "RA_OF_ASC_NODE": 339.3774,
    "ARG_OF_PERICENTER": 118.0573,
    "MEAN_ANOMALY": 242.3843,
    "NORAD_CAT_ID": 49066,
}
OEM = "CCSDS_OEM_VERS = 2.0\nMETA_START\nREF_FRAME = ITRF\nTIME_SYSTEM = UTC\nSTART_TIME = 2022-050T00:00:00\n" + (
    "STOP_TIME = 2022-050T00:03:00\nMETA_STOP\n"
    + "".join(f"2022-02-19T00:0{i}:00 {6900 - i} {420 * i} 0 0 7.0 0\n" for i in range(4))
)


@pytest.mark.parametrize(
    ("text", "media_type", "kind"),
    [
        (json.dumps(STATE), "application/json", "state"),
        (json.dumps([STATE]), None, "state"),
        (json.dumps(OMM), "application/json; charset=utf-8", "omm"),
        (json.dumps([OMM, OMM]), "application/octet-stream", "omm"),
        (",".join(OMM) + "\n" + ",".join(map(str, OMM.values())), "text/csv", "omm"),
        ("CCSDS_OMM_VERS = 2.0\n" + "".join(f"{k} = {v}\n" for k, v in OMM.items()), "text/plain", "omm"),
        (OEM, "text/plain", "oem"),
        ("\ufeff" + OEM, None, "oem"),
    ],
)
def test_the_form_is_found_from_the_content(text: str, media_type: str | None, kind: str) -> None:
    for content in (text, text.encode()):
        sources = parse_sources(content, media_type)
        assert {source.kind for source in sources} == {kind}
        again = parse_sources(sources[0].text)[0]
        assert (again.kind, again.text, again.epoch_utc) == (kind, sources[0].text, sources[0].epoch_utc)
        place_km = sources[0].orbit.position_itrf_km(np.array([sources[0].epoch_utc]))
        assert 6300 < np.linalg.norm(place_km) < 7500


def test_tles_are_split_into_sources_with_their_names(data_dir: Path) -> None:
    sources = parse_sources((data_dir / "dekart.tle.txt").read_bytes(), "text/plain")
    assert [(source.name, source.norad_id, source.cospar_id) for source in sources] == [
        ("DEKART 2022-02-19", "46493", "2020-068H"),
        ("DEKART 2022-04-07", "46493", "2020-068H"),
    ]
    assert [parse_sources(source.text)[0].name for source in sources] == [source.name for source in sources]
    assert [orbit.model for orbit in parse_orbits((data_dir / "dekart.tle.txt").read_text())] == ["sgp4", "sgp4"]


def test_an_ephemeris_says_until_when() -> None:
    (source,) = parse_sources(OEM)
    assert source.until_utc == np.datetime64("2022-02-19T00:03:00")


@pytest.mark.parametrize(
    ("content", "media_type", "error"),
    [
        (json.dumps(STATE), "text/plain", OrbitFormatError),
        (OEM, "application/json", OrbitFormatError),
        (b"\xff\xfe1\x00", None, EncodingError),
        ("", None, TleFormatError),
        ("[]", None, OrbitFormatError),
        ('"x"', None, TleFormatError),
        ("[" * 100_000, None, OrbitFormatError),
        ("{}", None, OrbitFormatError),
        ("<oem/>", None, OrbitFormatError),
        ("<html/>", None, OrbitFormatError),
        (b" " * (64 * 2**20 + 1), None, OrbitFormatError),
    ],
)
def test_what_is_no_orbit_is_refused(content: bytes | str, media_type: str | None, error: type[Exception]) -> None:
    with pytest.raises(error):
        parse_sources(content, media_type)


def test_a_wrong_checksum_keeps_its_name(data_dir: Path) -> None:
    text = (data_dir / "dekart.tle.txt").read_text().replace("9996", "9995")
    with pytest.raises(TleChecksumError):
        parse_sources(text)

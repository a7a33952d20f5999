"""OMMs in their four forms: the same orbit as the TLE, and every wrong value named."""

import json
from pathlib import Path

import numpy as np
import pytest
from sgp4 import omm as sgp4_omm
from sgp4.api import Satrec

from magcal_core.errors import OrbitFormatError
from magcal_core.orbit.messages.omm import parse_omms
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit

FIELDS = {
    "OBJECT_NAME": "BRO-4",
    "OBJECT_ID": "2021-073A",
    "EPOCH": "2021-09-23T05:32:45.214368",
    "MEAN_MOTION": "15.08183038",
    "ECCENTRICITY": ".0031328",
    "INCLINATION": "97.5553",
    "RA_OF_ASC_NODE": "339.3774",
    "ARG_OF_PERICENTER": "118.0573",
    "MEAN_ANOMALY": "242.3843",
    "EPHEMERIS_TYPE": "0",
    "CLASSIFICATION_TYPE": "U",
    "NORAD_CAT_ID": "49066",
    "ELEMENT_SET_NO": "999",
    "REV_AT_EPOCH": "559",
    "BSTAR": ".40581E-4",
    "MEAN_MOTION_DOT": ".57E-5",
    "MEAN_MOTION_DDOT": "0",
}
META = {"CENTER_NAME": "EARTH", "REF_FRAME": "TEME", "TIME_SYSTEM": "UTC", "MEAN_ELEMENT_THEORY": "SGP4"}


def _xml(fields: dict[str, str]) -> str:
    def tags(names: list[str]) -> str:
        return "".join(f"<{name}>{(fields | META)[name]}</{name}>" for name in names)

    names = list(fields)
    return (
        '<?xml version="1.0" encoding="UTF-8"?><ndm><omm id="CCSDS_OMM_VERS" version="2.0"><header/><body><segment>'
        f"<metadata>{tags(names[:2] + list(META))}</metadata><data><meanElements>{tags(names[2:9])}</meanElements>"
        f"<tleParameters>{tags(names[9:])}</tleParameters></data></segment></body></omm></ndm>"
    )


TEXTS = {
    "json": json.dumps([FIELDS]),
    "xml": _xml(FIELDS),
    "csv": ",".join(FIELDS) + "\r\n" + ",".join(FIELDS.values()) + "\r\n",
    "kvn": "CCSDS_OMM_VERS = 2.0\nCOMMENT x = y\n"
    + "".join(f"{key:20} = {value}\n" for key, value in (META | FIELDS).items()),
}


@pytest.mark.parametrize("form", list(TEXTS))
def test_every_form_gives_the_orbit_that_sgp4_itself_reads(form: str) -> None:
    (message,) = parse_omms(TEXTS[form], form)
    satellite = Satrec()
    sgp4_omm.initialize(satellite, FIELDS)
    orbit = Sgp4Orbit(message)
    t_utc = orbit.epoch_utc + (np.arange(0, 86400, 600) * 10**9).astype("timedelta64[ns]")
    minutes = (t_utc - orbit.epoch_utc) / np.timedelta64(1, "m")
    want_km = np.array([satellite.sgp4_tsince(minute)[1] for minute in minutes])
    np.testing.assert_allclose(orbit.state_teme(t_utc)[0], want_km, rtol=0, atol=1e-6)
    assert (message.name, message.norad_id, message.cospar_id) == ("BRO-4", "49066", "2021-073A")
    assert message.epoch_utc == np.datetime64("2021-09-23T05:32:45.214368")


@pytest.mark.real_data
def test_the_message_is_the_tle(bro4_dir: Path) -> None:
    """Epoch to 1e-8 day and elements as the TLE prints them; 1e-4 km is the epoch's rounding."""
    by_tle = Sgp4Orbit.from_tle((bro4_dir / "tle.txt").read_text())
    by_omm = Sgp4Orbit(parse_omms(TEXTS["json"], "json")[0])
    t_utc = by_tle.epoch_utc + (np.arange(0, 86400, 600) * 10**9).astype("timedelta64[ns]")
    np.testing.assert_allclose(by_omm.state_teme(t_utc)[0], by_tle.state_teme(t_utc)[0], rtol=0, atol=1e-4)


def test_a_message_written_back_is_the_same() -> None:
    (message,) = parse_omms(TEXTS["xml"], "xml")
    assert parse_omms(message.text, "json") == [message]


def test_numbers_past_five_digits_are_what_omms_are_for() -> None:
    (message,) = parse_omms(json.dumps(FIELDS | {"NORAD_CAT_ID": 270000123}), "json")
    assert message.norad_id == "270000123"
    assert np.isfinite(Sgp4Orbit(message).position_itrf_km(np.array([message.epoch_utc]))).all()


@pytest.mark.parametrize(
    ("change", "where", "why"),
    [
        ({"ECCENTRICITY": "1.5"}, "message 1, ECCENTRICITY", "want 0 to 1"),
        ({"INCLINATION": "nan"}, "message 1, INCLINATION", "want 0 to 180"),
        ({"MEAN_MOTION": ""}, "message 1, MEAN_MOTION", "is missing"),
        ({"MEAN_MOTION": "18"}, "message 1, MEAN_MOTION", "below the ground"),
        ({"BSTAR": "x"}, "message 1, BSTAR", "is not a number"),
        ({"EPOCH": "21266.23107887"}, "message 1, EPOCH", "is not an epoch"),
        ({"REF_FRAME": "GCRF"}, "message 1, REF_FRAME", "want TEME"),
        ({"TIME_SYSTEM": "TAI"}, "message 1, TIME_SYSTEM", "want UTC"),
        ({"MEAN_ELEMENT_THEORY": "SGP4-XP"}, "message 1, MEAN_ELEMENT_THEORY", "want SGP4"),
        ({"EPHEMERIS_TYPE": "4"}, "message 1, EPHEMERIS_TYPE", "want 0"),
        ({"CENTER_NAME": "MOON"}, "message 1, CENTER_NAME", "want EARTH"),
        ({"NORAD_CAT_ID": "49066.7"}, "message 1, NORAD_CAT_ID", "want an integer"),
        ({"NORAD_CAT_ID": "A9066"}, "message 1, NORAD_CAT_ID", "want an integer"),
        ({"NORAD_CAT_ID": "1000000000"}, "message 1, NORAD_CAT_ID", "at most nine digits"),
        ({"MEAN_MOTION": "15_08.1"}, "message 1, MEAN_MOTION", "is not a number"),
    ],
)
def test_each_wrong_value_is_named(change: dict[str, str], where: str, why: str) -> None:
    with pytest.raises(OrbitFormatError) as caught:
        parse_omms(json.dumps(FIELDS | change), "json")
    assert caught.value.faults[0].where == where
    assert why in caught.value.faults[0].why


@pytest.mark.parametrize(
    ("form", "text"),
    [
        ("json", "[1]"),
        ("json", "{"),
        ("json", "[]"),
        ("json", "[" * 100_000),
        ("xml", "<ndm>"),
        ("xml", "<ndm/>"),
        ("xml", '<!DOCTYPE x [<!ENTITY a "b">]><ndm>&a;</ndm>'),
        ("csv", "OBJECT_NAME,EPOCH\n"),
        ("kvn", "OBJECT_NAME = X\n"),
        ("kvn", "CCSDS_OMM_VERS = 2.0\nhello\n"),
    ],
)
def test_malformed_texts_are_refused(form: str, text: str) -> None:
    with pytest.raises(OrbitFormatError):
        parse_omms(text, form)

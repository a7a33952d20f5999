"""The forms of orbit files: each is read as the orbit that it is of, or named."""

import gzip
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from magcal_core.errors import EncodingError, InputError, OrbitFormatError, TleFormatError
from magcal_core.orbit.earth.frames import convert_state
from magcal_core.orbit.messages.forms import FORMS
from magcal_core.orbit.messages.frames_of_date import OF_DATE, in_known_frame
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.orbit.sources import MAX_BYTES, OrbitSource, parse_sources

T0 = np.datetime64("2022-02-19T22:00:00", "ns")
GPS_MINUS_UTC = np.timedelta64(18, "s")


@pytest.fixture(scope="module")
def tle(data_dir: Path) -> str:
    return "\n".join((data_dir / "dekart.tle.txt").read_text().splitlines()[:3]) + "\n"


@pytest.fixture(scope="module")
def orbit(tle: str) -> Sgp4Orbit:
    return Sgp4Orbit.from_tle(tle)


def states(orbit: Sgp4Orbit, frame: str, step_s: int = 60, count: int = 40):
    t_utc = T0 + np.arange(count) * np.timedelta64(step_s, "s")
    return (t_utc, *convert_state(t_utc, *orbit.state_gcrf(t_utc), "GCRF", frame))


def assert_is(source: OrbitSource, orbit: Sgp4Orbit, tolerance_km: float) -> None:
    t_utc = T0 + np.timedelta64(300, "s") + np.arange(0, 1500, 7) * np.timedelta64(1, "s")
    apart_km = np.linalg.norm(source.orbit.position_itrf_km(t_utc) - orbit.position_itrf_km(t_utc), axis=1)
    assert apart_km.max() < tolerance_km
    again = parse_sources(source.text)[0]
    assert (again.kind, again.epoch_utc) == (source.kind, source.epoch_utc)


def sp3(
    orbit: Sgp4Orbit, version: str, system: str = "GPS", *, velocities: bool = True, ids: tuple[str, ...] = ("L49",)
):
    t_utc, r_km, v_km_s = states(orbit, "ITRF")
    shift = GPS_MINUS_UTC if system == "GPS" else np.timedelta64(0, "s")
    lines = [f"#{version}{'V' if velocities else 'P'}2022  2 19 22  0  0.00000000      40 ORBIT IGS14 FIT  XYZ"]
    lines += ["## 2197 597618.00000000    60.00000000 59629 0.9168750000000", f"+    {len(ids)}   {''.join(ids)}"]
    lines += [f"%c L  cc {system} ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc", "/* an orbit of a test"]
    for t, r, v in zip(t_utc + shift, r_km, v_km_s, strict=True):
        day, clock = str(t).split("T")
        year, month, date = (int(part) for part in day.split("-"))
        hour, minute, second = clock.split(":")
        lines.append(f"*  {year:4d} {month:2d} {date:2d} {int(hour):2d} {int(minute):2d} {float(second):11.8f}")
        for name in ids:
            lines.append(f"P{name}" + "".join(f"{x:14.6f}" for x in r) + " 999999.999999")
            if velocities:
                lines.append(f"V{name}" + "".join(f"{x * 1e4:14.6f}" for x in v) + " 999999.999999")
    return "\n".join([*lines, "EOF"]) + "\n"


@pytest.mark.parametrize(
    ("version", "system", "velocities"), [("c", "GPS", True), ("d", "UTC", True), ("d", "GPS", False)]
)
def test_sp3_c_and_d_are_read(orbit, version, system, velocities):
    """Millimetres in the file, points of a minute; SGP4's velocities miss its slope by millimetres a second."""
    (source,) = parse_sources(sp3(orbit, version, system, velocities=velocities), "text/plain")
    assert (source.kind, source.name) == ("oem", "L49")
    assert source.epoch_utc == T0
    assert_is(source, orbit, 5e-4)


@pytest.mark.parametrize("version", ["a", "b"])
def test_older_sp3_is_named_with_its_version(orbit, version):
    with pytest.raises(OrbitFormatError, match=f"this is an SP3 file of version {version}; c and d are read"):
        parse_sources(sp3(orbit, version))


def test_an_sp3_file_of_several_satellites_or_another_frame_is_refused(orbit):
    with pytest.raises(OrbitFormatError, match=r"2 satellites \(L48, L49\); leave the one that it is"):
        parse_sources(sp3(orbit, "c", ids=("L48", "L49")))
    with pytest.raises(OrbitFormatError, match="coordinate system is not Earth-fixed"):
        parse_sources(sp3(orbit, "c").replace("IGS14", "J2000"))
    with pytest.raises(OrbitFormatError, match="time system"):
        parse_sources(sp3(orbit, "c").replace(" GPS ", " XYZ "))


def stk(orbit: Sgp4Orbit, system: str, unit: str, *, velocities: bool = True) -> str:
    frame = {"Fixed": "ITRF", "ICRF": "GCRF", "J2000": "EME2000", "TEMEOfDate": "TEME"}[system]
    t_utc, r_km, v_km_s = states(orbit, frame)
    factor = 1e3 if unit == "Meters" else 1.0
    head = ["stk.v.11.0", "# WrittenBy    a test", "BEGIN Ephemeris", f"NumberOfEphemerisPoints {len(t_utc)}"]
    head += ["ScenarioEpoch            19 Feb 2022 22:00:00.000000", "InterpolationMethod     Lagrange"]
    head += ["InterpolationOrder  5", f"DistanceUnit   {unit}", "CentralBody   Earth", f"CoordinateSystem   {system}"]
    table = "EphemerisTimePosVel" if velocities else "EphemerisTimePos"
    rows = []
    for t, r, v in zip(t_utc, r_km * factor, v_km_s * factor, strict=True):
        cells = [*r, *v] if velocities else r
        rows.append(f" {(t - T0) / np.timedelta64(1, 's'):.14e} " + " ".join(f"{x:.14e}" for x in cells))
    return "\n".join([*head, table, *rows, "", "END Ephemeris"]) + "\n"


@pytest.mark.parametrize("system", ["Fixed", "ICRF", "J2000", "TEMEOfDate"])
@pytest.mark.parametrize(("unit", "velocities"), [("Meters", True), ("Kilometers", False)])
def test_stk_ephemerides_are_read(orbit, system, unit, velocities):
    """Lagrange 5 between points of a minute is some metres off, as STK itself would be."""
    (source,) = parse_sources(stk(orbit, system, unit, velocities=velocities))
    assert source.kind == "oem"
    assert_is(source, orbit, 2e-3)


def test_stk_files_that_are_not_read_are_named(orbit):
    text = stk(orbit, "Fixed", "Meters")
    with pytest.raises(OrbitFormatError, match="want one of Fixed, ICRF, J2000, TEMEOfDate, TrueOfDate, MeanOfDate"):
        parse_sources(text.replace("Fixed", "TrueOfEpoch"))
    with pytest.raises(OrbitFormatError, match="this is an STK file of Attitude; ephemerides"):
        parse_sources(text.replace("BEGIN Ephemeris", "BEGIN Attitude"))
    with pytest.raises(OrbitFormatError, match="line 14: want 7 numbers"):
        parse_sources("\n".join([*text.splitlines()[:13], "1.0 2.0", *text.splitlines()[13:]]))


def opm(orbit: Sgp4Orbit, *, is_xml: bool, system: str = "UTC", frame: str = "EME2000", extra: str = "") -> str:
    t_utc, r_km, v_km_s = states(orbit, "EME2000", count=1)
    shift = {"UTC": 0, "GPS": 18, "TAI": 37}[system]
    epoch = np.datetime_as_string(t_utc[0] + np.timedelta64(shift, "s"), unit="ms")
    values = dict(
        zip(("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"), (*r_km[0].tolist(), *v_km_s[0].tolist()), strict=True)
    )
    meta = {
        "OBJECT_NAME": "DEKART",
        "OBJECT_ID": "2020-068H",
        "CENTER_NAME": "EARTH",
        "REF_FRAME": frame,
        "TIME_SYSTEM": system,
    }
    if is_xml:
        cells = lambda rows: "".join(f"<{k}>{v!s}</{k}>" for k, v in rows.items())  # noqa: E731
        state = f"<stateVector>{cells({'EPOCH': epoch} | values)}</stateVector>"
        body = f"<metadata>{cells(meta)}</metadata><data>{state}</data>"
        return f'<?xml version="1.0"?><opm id="CCSDS_OPM_VERS"><body><segment>{body}</segment></body></opm>'
    lines = [f"{k} = {v}" for k, v in (meta | {"EPOCH": epoch}).items()]
    units = [f"{k} = {v!r} [{'km/s' if 'DOT' in k else 'km'}]" for k, v in values.items()]
    return "\n".join(
        ["CCSDS_OPM_VERS = 2.0", "CREATION_DATE = 2022-02-20", *lines, "COMMENT x", *units, "MASS = 7.5 [kg]", extra]
    )


@pytest.mark.parametrize("is_xml", [False, True])
@pytest.mark.parametrize("system", ["UTC", "GPS", "TAI"])
def test_opms_are_state_vectors(orbit, is_xml, system):
    (source,) = parse_sources(opm(orbit, is_xml=is_xml, system=system))
    assert (source.kind, source.name, source.cospar_id, source.epoch_utc) == ("state", "DEKART", "2020-068H", T0)
    at = np.array([T0])
    np.testing.assert_allclose(source.orbit.position_itrf_km(at), orbit.position_itrf_km(at), atol=1e-6)
    assert parse_sources(source.text)[0].text == source.text


def test_an_opm_that_cannot_be_used_is_refused_by_its_keyword(orbit):
    with pytest.raises(OrbitFormatError, match="MAN_EPOCH_IGNITION: manoeuvres are not integrated"):
        parse_sources(opm(orbit, is_xml=False, extra="MAN_EPOCH_IGNITION = 2022-02-19T23:00:00"))
    with pytest.raises(OrbitFormatError, match="REF_FRAME: want one of GCRF"):
        parse_sources(opm(orbit, is_xml=False, frame="RSW"))
    with pytest.raises(OrbitFormatError, match="X_DOT: is missing"):
        parse_sources(opm(orbit, is_xml=False).replace("X_DOT", "U"))


@pytest.mark.parametrize("frame", sorted(OF_DATE))
def test_frames_of_date_are_turned_as_independent_matrices_turn_them(orbit, frame):
    """Of date against ERFA's IAU 1976/1980 matrices, 3 m apart at the most; PEF back through W, exactly."""
    import erfa

    t_utc, r_km, v_km_s = states(orbit, "GCRF", count=3)
    day, fraction = erfa.epj2jd(2022.1367)
    older = erfa.pnm80(day, fraction) if frame.startswith("TOD") else erfa.pmat76(day, fraction)
    if OF_DATE[frame] == "GCRF":
        of_date_km = r_km @ older.T
        known, back_km, _ = in_known_frame(frame, t_utc, of_date_km, v_km_s)
        assert known == "GCRF"
        np.testing.assert_allclose(back_km, r_km, atol=3e-3)
    else:
        known, back_km, _ = in_known_frame(frame, t_utc, r_km, v_km_s)
        assert known == "ITRF"
        assert 1e-3 < np.linalg.norm(back_km - r_km, axis=1).max() < 3e-2


def test_an_oem_of_date_is_read(orbit):
    t_utc, r_km, v_km_s = states(orbit, "ITRF")
    rows = "".join(
        " ".join([np.datetime_as_string(t, unit="ms"), *map(repr, [*r, *v])]) + "\n"
        for t, r, v in zip(t_utc, r_km.tolist(), v_km_s.tolist(), strict=True)
    )
    span = f"START_TIME = {t_utc[0]}\nSTOP_TIME = {t_utc[-1]}\n"
    head = f"CCSDS_OEM_VERS = 2.0\nMETA_START\nREF_FRAME = TDR\nTIME_SYSTEM = UTC\n{span}META_STOP\n"
    (source,) = parse_sources(head + rows)
    assert_is(source, orbit, 0.03)


def satnogs(tle: str) -> dict[str, object]:
    name, one, two = tle.splitlines()
    return {"tle0": f"0 {name}", "tle1": one, "tle2": two, "tle_source": "Celestrak", "norad_cat_id": 46493}


@pytest.mark.parametrize(
    "wrap",
    [
        lambda tle: [satnogs(tle)],
        satnogs,
        lambda tle: {"results": [satnogs(tle)], "next": None},
        lambda tle: {"TLE_LINE0": "0 DEKART", "TLE_LINE1": tle.splitlines()[1], "TLE_LINE2": tle.splitlines()[2]},
        lambda tle: {
            "satelliteId": 46493,
            "name": "DEKART",
            "line1": tle.splitlines()[1],
            "line2": tle.splitlines()[2],
        },
        lambda tle: {"info": {"satid": 46493}, "tle": "\r\n".join(tle.splitlines()[1:])},
        lambda tle: {"name": "DEKART", "tle": tle.splitlines()[1:]},
    ],
)
def test_tles_inside_json_are_read(tle, orbit, wrap):
    (source,) = parse_sources(json.dumps(wrap(tle)), "application/json")
    assert (source.kind, source.norad_id) == ("tle", "46493")
    assert source.orbit.epoch_utc == orbit.epoch_utc
    assert source.name.startswith("DEKART") or source.name == ""


@pytest.mark.parametrize(
    "around",
    [
        "Dear all,\n\nplease find below the elements of today.\n\n{}\nBest regards\nFlight Dynamics",
        "BULLETIN 12, 2022-02-19 (see note 1)\n1. The orbit is as follows:\n\n{}\n2 more follow tomorrow.\n",
        "On Saturday, someone wrote:\n> {}",
    ],
)
def test_bulletins_with_text_around_tles_are_read(tle, orbit, around):
    body = tle.replace("\n", "\n> ") if around.endswith("> {}") else tle
    (source,) = parse_sources(around.format(body))
    assert source.orbit.epoch_utc == orbit.epoch_utc
    assert source.name == "DEKART 2022-02-19"


def test_a_damaged_tle_in_a_bulletin_stays_a_fault(tle):
    broken = tle.replace("97.7186", "97.71 6")
    with pytest.raises(TleFormatError, match="inclination is malformed"):
        parse_sources(f"Some words about it.\n{broken}{tle}")
    cut = "\n".join(tle.splitlines()[:2])
    with pytest.raises(TleFormatError, match="line 2 does not follow"):
        parse_sources(f"{tle}{cut}\n")


SPACE_TRACK = {
    "CCSDS_OMM_VERS": "3.0", "COMMENT": "GENERATED VIA SPACE-TRACK.ORG API", "CREATION_DATE": "2022-02-19T18:46:17",
    "ORIGINATOR": "18 SPCS", "OBJECT_NAME": "DEKART", "OBJECT_ID": "2020-068H", "CENTER_NAME": "EARTH",
    "REF_FRAME": "TEME", "TIME_SYSTEM": "UTC", "MEAN_ELEMENT_THEORY": "SGP4", "EPOCH": "2022-02-19T22:37:44.130000",
    "MEAN_MOTION": "15.04187815", "ECCENTRICITY": "0.00172690", "INCLINATION": "97.7186", "RA_OF_ASC_NODE": "352.5293",
    "ARG_OF_PERICENTER": "326.3404", "MEAN_ANOMALY": "33.6715", "EPHEMERIS_TYPE": "+0", "NORAD_CAT_ID": "46493",
    "BSTAR": "0.0", "TLE_LINE0": "0 DEKART, the second",
}  # fmt: skip


def quoted_csv(rows: list[dict[str, str]]) -> str:
    line = lambda cells: ",".join(f'"{cell}"' for cell in cells)  # noqa: E731
    return "\n".join([line(rows[0]), *(line(row.values()) for row in rows)]) + "\n"


def test_the_csv_of_space_track_is_told_by_its_header_and_read_with_a_plus_zero(orbit):
    """A header in another order, in quotes, with no column that begins the text with OBJECT_."""
    for row in (SPACE_TRACK, dict(reversed(SPACE_TRACK.items()))):
        (source,) = parse_sources(quoted_csv([row]), "text/csv")
        assert (source.kind, source.name, source.norad_id) == ("omm", "DEKART", "46493")
        assert abs(source.epoch_utc - orbit.epoch_utc) < np.timedelta64(1, "ms")
    plain = "MEAN_MOTION,ECCENTRICITY,INCLINATION,RA_OF_ASC_NODE,ARG_OF_PERICENTER,MEAN_ANOMALY,EPOCH\n"
    assert parse_sources(plain + "15.04,0.0017,97.7,352.5,326.3,33.7,2022-02-19T22:37:44\n")[0].kind == "omm"


def test_a_csv_row_of_another_width_than_its_header_is_refused():
    text = quoted_csv([SPACE_TRACK, SPACE_TRACK])
    short = text[: text.rindex('","')] + '"\n'
    with pytest.raises(OrbitFormatError, match="OMM in CSV, line 3: 20 cells, the header has 21"):
        parse_sources(short)
    with pytest.raises(OrbitFormatError, match="line 3: 22 cells, the header has 21"):
        parse_sources(text.rstrip() + ',"x"\n')


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("<!DOCTYPE html><html><head><title>Log in | Space</title></head></html>", "an HTML page, 'Log in | Space'"),
        ("<html><body>503 Service Unavailable</body></html>", "an HTML page, not an orbit"),
        ("No GP data found", "a server's message, not an orbit: 'No GP data found'"),
        ("429 Too Many Requests\n", "a server's message, not an orbit: '429 Too Many Requests'"),
        ("Invalid query: \"CATNR=x\" (CATNR must be an integer)", "a server's message, not an orbit"),
        ('{"error": "You must be logged in to do this"}', "a server's message, not an orbit: 'You must be logged in"),
        ('[{"error": "Failed"}]', "a server's message, not an orbit: 'Failed'"),
        ('{"detail": "Not found."}', "a server's message, not an orbit: 'Not found.'"),
        ("CCSDS_AEM_VERS = 1.0\n", "an attitude message .* which is not read"),
        ("CCSDS_CDM_VERS = 1.0\n", "a conjunction message .* which is not read; read are TLE, OMM, OPM, OEM, SP3-c"),
        ("CCSDS_OCM_VERS = 3.0\n", "an orbit comprehensive message"),
        ('<?xml version="1.0"?><tdm id="CCSDS_TDM_VERS"></tdm>', "a tracking message"),
        ("H1 CPF  2  AIU 2022  2 19 18  5501 01 sat\n", "a prediction for laser ranging"),
        (f"{'     3.04           OBSERVATION DATA    M':<60}RINEX VERSION / TYPE\n", "a RINEX file"),
        ('<?xml version="1.0"?><kml xmlns="x"></kml>', "a KML file"),
        (b"DAF/SPK \x00\x01\xff", "an SPK kernel"),
        (b"PK\x03\x04xx", "a zip archive"),
        ("time,x,y,z\n2022-02-19T22:00:00Z,1,2,3\n", "a table of positions"),
    ],
)  # fmt: skip
def test_what_is_not_an_orbit_or_not_read_is_named(content, words):
    with pytest.raises(OrbitFormatError, match=words) as caught:
        parse_sources(content)
    assert caught.value.message.isprintable()


def test_a_servers_message_does_not_reach_a_terminal_raw():
    with pytest.raises(OrbitFormatError) as caught:
        parse_sources("Error \x1b[31m" + "x" * 500)
    assert caught.value.message.isprintable()
    assert len(caught.value.message) < 160


@pytest.mark.parametrize("name", [form.name for form in FORMS if form.is_read])
def test_every_form_that_is_read_has_a_reader(name):
    from magcal_core.orbit.sources import _READERS

    assert name in _READERS


@pytest.mark.parametrize(
    "noise", ["", "\x00", "{", "[1]", "<x/>", "#cP2022", "stk.v.11.0\n", "*", "CCSDS_OPM_VERS = 2.0\n", "1 \n2 \n"]
)
def test_no_text_escapes_as_another_error(noise):
    with pytest.raises((InputError, EncodingError)):
        parse_sources(noise)


def d_exponents(text: str) -> str:
    return re.sub(r"(\d)e([+-]\d)", r"\1D\2", text)


def repeated(text: str, line: int) -> str:
    lines = text.splitlines()
    return "\n".join([*lines[:line], lines[line - 1], *lines[line:]])


ANY_FORM = {
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "byte order mark": lambda text: "\ufeff" + text,
    "blank lines": lambda text: "\n\n" + text + "\n\n  \n",
    "gzip": lambda text: gzip.compress(text.encode()),
}
STK_WAYS = ANY_FORM | {
    "Fortran's exponents": d_exponents,
    "a comment first": lambda text: f"# exported for somebody\n{text}",
    "nanoseconds": lambda text: text.replace("22:00:00.000000", "22:00:00.000000000"),
    "a day of the year": lambda text: text.replace("19 Feb 2022 22:00:00.000000", "2022-050T22:00:00.000"),
    "a state twice": lambda text: repeated(text, 30),
    "boundaries": lambda text: text.replace(
        "EphemerisTimePosVel",
        "BEGIN SegmentBoundaryTimes\n 0.0\n 1200.0\nEND SegmentBoundaryTimes\nEphemerisTimePosVel",
    ),
}
SP3_WAYS = ANY_FORM | {
    "correlations": lambda text: re.sub(r"^(P.*)$", r"\1\nEP  55  55  55     222", text, flags=re.MULTILINE),
    "deviations and flags": lambda text: re.sub(r"^(P.*)$", r"\1  5  5  5 222 E  M", text, flags=re.MULTILINE),
    "no clock": lambda text: text.replace(" 999999.999999", ""),
    "another realisation": lambda text: text.replace("IGS14", "IGb20"),
}


@pytest.mark.parametrize("way", STK_WAYS)
def test_stk_ephemerides_are_read_as_producers_write_them(orbit, way):
    (source,) = parse_sources(STK_WAYS[way](stk(orbit, "ICRF", "Meters")))
    assert_is(source, orbit, 2e-3)


@pytest.mark.parametrize("way", SP3_WAYS)
def test_sp3_files_are_read_as_producers_write_them(orbit, way):
    (source,) = parse_sources(SP3_WAYS[way](sp3(orbit, "d")))
    assert_is(source, orbit, 5e-4)


OPM_WAYS = ANY_FORM | {
    "lower case": lambda text: re.sub(r"^([A-Z_]+) =", lambda one: f"{one[1].lower()} =", text, flags=re.MULTILINE),
    "elements, covariance and words of its own": lambda text: (
        f"{text}\nSEMI_MAJOR_AXIS = 6900 [km]\nGM = 398600.4415 [km**3/s**2]\n"
        "COV_REF_FRAME = RTN\nCX_X = 1e-3 [km**2]\nUSER_DEFINED_WORD = 7"
    ),
}


@pytest.mark.parametrize("way", OPM_WAYS)
def test_opms_are_read_as_producers_write_them(orbit, way):
    (source,) = parse_sources(OPM_WAYS[way](opm(orbit, is_xml=False)))
    at = np.array([T0])
    np.testing.assert_allclose(source.orbit.position_itrf_km(at), orbit.position_itrf_km(at), atol=1e-6)


def oem(orbit: Sgp4Orbit, frame: str = "GCRF", *, form: str = "{:.9f}", segments: int = 1, more: str = "") -> str:
    """Return an OEM with a point a minute; ``more`` stands behind the points of each segment."""
    t_utc, r_km, v_km_s = states(orbit, frame)
    lines = ["CCSDS_OEM_VERS = 2.0", "CREATION_DATE = 2022-02-19T00:00:00", "ORIGINATOR = X", ""]
    for part in np.array_split(np.arange(len(t_utc)), segments):
        rows = np.arange(max(part[0] - 1, 0), part[-1] + 1)
        meta = {"OBJECT_NAME": "X", "OBJECT_ID": "2020-068H", "CENTER_NAME": "Earth", "REF_FRAME": frame,
                "TIME_SYSTEM": "UTC", "START_TIME": t_utc[rows[0]], "STOP_TIME": t_utc[rows[-1]],
                "INTERPOLATION": "Hermite", "INTERPOLATION_DEGREE": 7}  # fmt: skip
        lines += ["META_START", *(f"{key} = {value}" for key, value in meta.items()), "META_STOP", ""]
        lines += [f"{t_utc[i]} " + " ".join(form.format(x) for x in (*r_km[i], *v_km_s[i])) for i in rows]
        lines += [more]
    return "\n".join(lines) + "\n"


COVARIANCE = "\n".join(
    ["COVARIANCE_START", "EPOCH = 2022-02-19T22:10:00", "COV_REF_FRAME = RTN",
     *(" ".join(["1e-4"] * n) for n in range(1, 7)), "COVARIANCE_STOP"]
)  # fmt: skip
EMPTY = "\n".join(
    ["META_START", "OBJECT_NAME = X", "REF_FRAME = GCRF", "TIME_SYSTEM = UTC", "START_TIME = 2022-02-20T00:00:00",
     "STOP_TIME = 2022-02-21T00:00:00", "META_STOP"]
)  # fmt: skip
OEM_WAYS = ANY_FORM | {
    "lower case": lambda text: re.sub(r"^([A-Z_]+)( =|$)", lambda one: one[0].lower(), text, flags=re.MULTILINE),
    "no degree": lambda text: text.replace("INTERPOLATION_DEGREE = 7\n", ""),
    "a state twice": lambda text: repeated(text, 30),
    "comments among the states": lambda text: re.sub(r"(T22:.5:.*)", r"\1\nCOMMENT a word = 1\n", text),
    "days of the year": lambda text: text.replace("2022-02-19T", "2022-050T"),
    "tabs": lambda text: re.sub(r"(?<=\d) (?=[-\d])", "\t", text),
    "an empty segment": lambda text: text + EMPTY,
}


@pytest.mark.parametrize("way", OEM_WAYS)
def test_oems_are_read_as_producers_write_them(orbit, way):
    (source,) = parse_sources(OEM_WAYS[way](oem(orbit)))
    assert_is(source, orbit, 1e-3)


@pytest.mark.parametrize("form", ["{:.12e}", "{:.12E}", "D"])
def test_exponents_of_every_language_are_read(orbit, form):
    text = oem(orbit, form="{:.12e}" if form == "D" else form, segments=3, more=COVARIANCE)
    assert_is(parse_sources(d_exponents(text) if form == "D" else text)[0], orbit, 1e-3)


@pytest.mark.parametrize(
    ("frame", "names"),
    [
        ("ITRF", ["ITRF-2014", "ITRF96", "ITRF1996", "IGS20", "IGb14", "ECEF", "WGS-84", "itrf2020"]),
        ("GCRF", ["ICRF3", "GCRF1", "gcrf"]),
        ("TEME", ["TEMEOFDATE", "TEME_OF_DATE"]),
    ],
)
def test_realisations_of_a_frame_are_that_frame(orbit, frame, names):
    for name in names:
        assert_is(parse_sources(oem(orbit, frame).replace(f"= {frame}", f"= {name}"))[0], orbit, 1e-3)
    with pytest.raises(OrbitFormatError, match="REF_FRAME: want one of GCRF"):
        parse_sources(oem(orbit, frame).replace(f"= {frame}", "= RSW2014"))


RECORD = {
    "OBJECT_NAME": "BRO-4", "OBJECT_ID": "2021-073A", "EPOCH": "2021-09-23T05:32:45.214368",
    "MEAN_MOTION": "15.08183038",
    "ECCENTRICITY": ".0031328", "INCLINATION": "97.5553", "RA_OF_ASC_NODE": "339.3774", "ARG_OF_PERICENTER": "118.0573",
    "MEAN_ANOMALY": "242.3843", "NORAD_CAT_ID": "49066", "BSTAR": ".40581E-4",
}  # fmt: skip


def table(separator: str = ",", names: Sequence[str] = tuple(RECORD)) -> str:
    return f"{separator.join(names)}\n{separator.join(RECORD.values())}\n"


@pytest.mark.parametrize(
    "text",
    [
        table(";"),
        table("\t"),
        table(names=[name.lower() for name in RECORD]),
        "# exported by somebody\n" + table(),
        "\ufeff" + table().replace("\n", "\r\n"),
        json.dumps({name.lower(): value for name, value in RECORD.items()}),
        json.dumps({"data": [RECORD], "count": 1}),
        json.dumps({"@context": "/x", "member": [RECORD | {"TLE_LINE1": "1", "TLE_LINE2": "2"}]}),
        gzip.compress(table().encode(), mtime=0),
    ],
)
def test_mean_elements_are_read_as_servers_send_them(text):
    (source,) = parse_sources(text)
    assert (source.kind, source.norad_id, source.name) == ("omm", "49066", "BRO-4")
    assert str(source.epoch_utc) == "2021-09-23T05:32:45.214368000"


def test_what_stands_beside_mean_elements_is_not_passed_over():
    with pytest.raises(OrbitFormatError, match="message 2, MEAN_MOTION: is missing"):
        parse_sources(json.dumps([RECORD, {"OBJECT_NAME": "Y"}]))
    with pytest.raises(OrbitFormatError, match="object"):
        parse_sources(json.dumps([RECORD, 5]))


def test_lists_of_lines_and_tle_1_and_2_are_tles(tle):
    lines = tle.splitlines()
    for content in (lines, {"tle_1": lines[1], "tle_2": lines[2]}, {"results": [{"tle": lines}]}):
        (source,) = parse_sources(json.dumps(content))
        assert (source.kind, source.norad_id) == ("tle", "46493")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'<?xml version="1.0"?><!DOCTYPE html PUBLIC "x"><html><title>Login</title></html>', "HTML page, 'Login'"),
        (b"<!-- built today --><HTML><title>Down</title>", "HTML page, 'Down'"),
        (gzip.compress(b"<html><title>403</title></html>", mtime=0), "HTML page, '403'"),
        (gzip.compress(table().encode(), mtime=0)[:-9], "gzip, but cut"),
        (b"\x1f\x8bnonsense", "gzip, but damaged"),
        (gzip.compress(bytes(MAX_BYTES + 1), mtime=0), "unpacked"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_pages_and_broken_archives_are_named(content, words):
    with pytest.raises(OrbitFormatError, match=words):
        parse_sources(content)

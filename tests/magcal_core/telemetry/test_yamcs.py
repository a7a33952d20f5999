"""Parameter exports of Yamcs, in the form that its archive's ``exportParameterValues`` writes."""

import numpy as np
import pytest

from magcal_core.errors import InputError
from magcal_core.telemetry import read_samples, read_telemetry

HEADER = "Time\t/DEKART/ADCS/MGM/bx\t/DEKART/ADCS/MGM/by\t/DEKART/ADCS/MGM/bz\t/DEKART/EPS/temperature"
EXPORT = "\n".join(
    [
        HEADER,
        "2022-02-19T22:37:43.900Z\t\t\t\t20.5",
        "2022-02-19T22:37:44.130Z\t20000.5\t-1.0E3\t9000.0\t",
        "2022-02-19T22:37:54.130Z\t20010.5\t-1010.0\t9010.0\t",
        "2022-02-19T22:37:55.000Z\t\t\t\t21.5",
        "2022-02-19T22:38:04.130Z\t20020.5\t-1020.0\t9020.0\t",
        "",
    ]
).encode()


def test_an_export_is_read_as_it_is():
    """Rows of other packets make no samples; what they brought is held until it comes again."""
    samples = read_samples(EXPORT)
    assert [str(t) for t in samples.t_utc] == [f"2022-02-19T22:{t}.130000000" for t in ("37:44", "37:54", "38:04")]
    np.testing.assert_array_equal(samples.h_nt[0], [20000.5, -1000.0, 9000.0])
    np.testing.assert_array_equal(samples.housekeeping["temperature"], [20.5, 20.5, 21.5])
    assert samples.is_used.all()


@pytest.mark.parametrize("separator", ["\t", ",", ";"])
def test_every_separator_that_an_export_can_have_is_told(separator):
    samples = read_samples(EXPORT.replace(b"\t", separator.encode()))
    np.testing.assert_array_equal(samples.h_nt, read_samples(EXPORT).h_nt)


@pytest.mark.parametrize("prefix", ["", "/DEKART/ADCS/MGM/"])
def test_columns_are_mapped_by_their_short_or_their_qualified_names(prefix):
    names = {"bx": f"{prefix}MAG_X", "by": f"{prefix}MAG_Y", "bz": f"{prefix}MAG_Z"}
    text = EXPORT
    for name, own in names.items():
        text = text.replace(f"MGM/{name}".encode(), f"MGM/{own.rpartition('/')[2]}".encode())
    samples = read_samples(text, columns=names)
    np.testing.assert_array_equal(samples.h_nt, read_samples(EXPORT).h_nt)
    assert list(samples.housekeeping) == ["temperature"]


def test_raw_and_monitoring_columns_do_no_harm():
    lines = EXPORT.decode().splitlines()
    head = f"{lines[0]}\t/DEKART/EPS/temperature_RAW\t/DEKART/EPS/temperature_MONITORING"
    text = "\n".join([head, *(f"{line}\t{i}\tIN_LIMITS" for i, line in enumerate(lines[1:]))])
    telemetry = read_telemetry(text.encode())
    assert set(telemetry.samples.housekeeping) == {"temperature", "temperature_RAW"}
    assert list(telemetry.quality.columns_ignored) == ["/DEKART/EPS/temperature_MONITORING"]


def test_a_short_name_that_two_parameters_have_is_not_guessed():
    two = EXPORT.replace(b"/DEKART/EPS/temperature", b"/DEKART/ADCS/MGM2/bx")
    with pytest.raises(InputError, match="bx"):
        read_samples(two)
    first = {"bx": "/DEKART/ADCS/MGM/bx"}
    assert read_samples(two, columns=first).h_nt.shape == (3, 3)


def test_an_old_attitude_is_not_held():
    text = EXPORT
    for name in ("qw", "qx", "qy", "qz"):
        lines = text.decode().splitlines()
        cells = ["", "", "0.5", "", ""]
        text = "\n".join(
            [f"{lines[0]}\t/DEKART/ADCS/{name}", *(f"{a}\t{b}" for a, b in zip(lines[1:], cells, strict=True))]
        ).encode()
    samples = read_samples(text, max_bad_fraction=1.0)
    assert samples.q_base_gcrf is not None
    assert np.isfinite(samples.q_base_gcrf).all(axis=1).tolist() == [False, True, False]

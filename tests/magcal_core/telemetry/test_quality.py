"""Flags, limits and units: what is left out, what is counted, what is refused."""

from pathlib import Path

import numpy as np
import pytest

from magcal_core.errors import TimeConflictError, TooManyBadSamplesError, UnitsError, UnitsMissingError
from magcal_core.samples import SampleFlag
from magcal_core.telemetry import merge_samples, read_samples, read_telemetry
from magcal_core.units import NT_PER_UNIT


def table(rows: int = 100, header: str = "time,bx,by,bz", cells: str = "30000,-1,2", **replaced: str) -> bytes:
    """Return a table of equal rows, row ``r7="..."`` replaced; times 10 s apart from 2020-09-13."""
    lines = [header] + [f"{1_600_000_000 + 10 * i},{replaced.get(f'r{i}', cells)}" for i in range(rows)]
    return "\n".join(lines).encode()


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "inf", "-Inf", "NA", "null", "1e308", "-1e301", "1e999"])
def test_a_cell_without_a_reading_flags_its_sample_and_keeps_it_out(cell: str) -> None:
    telemetry = read_telemetry(table(r7=f"30000,{cell},2"))
    assert telemetry.quality.flags == {"not_finite": 1}
    assert telemetry.quality.used == 99
    assert np.isnan(telemetry.samples.h_nt[7, 1])
    assert not telemetry.samples.is_used[7]


@pytest.mark.parametrize("cell", ["-9999", "-99999.9", "99999", "65535", "-999.9", "1e31", "9.969209968386869e36"])
def test_a_fill_value_foreign_among_its_neighbours_is_flagged_and_kept_out(cell: str) -> None:
    telemetry = read_telemetry(table(r7=f"30000,{cell},2"))
    assert telemetry.quality.flags == {"fill_value": 1}
    assert telemetry.samples.h_nt[7, 1] == float(cell), "a sample is flagged, never edited"
    assert not telemetry.samples.is_used[7]


def test_a_reading_that_equals_a_fill_value_among_its_like_stays() -> None:
    cells = {f"r{i}": f"{32000 + 11.8 * i:.1f},1,2" for i in range(100)} | {"r65": "32767,1,2"}
    assert read_telemetry(table(**cells)).quality.flags == {}


def test_denormals_and_negative_zero_are_readings() -> None:
    assert read_telemetry(table(r7="30000,5e-324,-0.0")).quality.flags == {}


def test_more_than_half_without_a_reading_are_refused() -> None:
    bad = {f"r{i}": ",," if i % 2 else "-9999,1,2" for i in range(51)}
    with pytest.raises(TooManyBadSamplesError, match=r"51 of 100 samples \(51.0 %\).*limit is 50 %"):
        read_samples(table(**bad))
    assert read_samples(table(**bad), max_bad_fraction=0.51).is_used.sum() == 49
    bad.pop("r0")
    assert read_samples(table(**bad)).is_used.sum() == 50


def test_fewer_than_ten_readings_beside_empty_ones_are_refused() -> None:
    with pytest.raises(TooManyBadSamplesError, match="9 are left, at least 10 are needed"):
        read_samples(table(rows=12, r0=",,", r1=",,", r2=",,"))
    assert read_samples(table(rows=13, r0=",,", r1=",,", r2=",,")).is_used.sum() == 10


def test_rows_without_a_time_are_left_out_and_counted() -> None:
    body = table().replace(b"1600000070,", b",").replace(b"1600000090,", b"nan,")
    telemetry = read_telemetry(body)
    assert len(telemetry.samples) == 98
    assert telemetry.quality.rows_without_time == 2
    assert telemetry.quality.rows == 100


def test_equal_rows_at_one_time_are_kept_once() -> None:
    body = table() + b"\n1600000070,30000,-1,2\n1600000070,30000,-1,2"
    telemetry = read_telemetry(body)
    assert telemetry.quality.flags == {"duplicate_time": 2}
    assert telemetry.samples.is_used.sum() == 100


def test_different_rows_at_one_time_are_all_left_out() -> None:
    telemetry = read_telemetry(table(rows=300) + b"\n1600000070,30000,-1,3")
    assert telemetry.quality.flags == {"conflicting_time": 2}


def test_more_than_one_per_cent_in_conflict_are_refused_with_their_times() -> None:
    with pytest.raises(TimeConflictError, match="2 of 101") as caught:
        read_samples(table() + b"\n1600000070,30000,-1,3")
    assert [fault.where for fault in caught.value.faults] == ["time 2020-09-13T12:27:50.000000Z"]


def test_an_empty_reading_is_in_conflict_with_nothing() -> None:
    telemetry = read_telemetry(table() + b"\n1600000070,,,")
    assert telemetry.quality.flags == {"not_finite": 1}
    assert telemetry.samples.is_used.sum() == 100


def test_readings_at_the_range_are_saturated_in_any_unit() -> None:
    body = table(cells="30,-1,2", r3="80,0,1", r4="0,-80.5,1", r5="79.99,0,0")
    samples = read_samples(body, unit="uT", range_nt=80_000.0)
    assert np.flatnonzero(samples.flags & SampleFlag.SATURATED).tolist() == [3, 4]
    assert samples.is_used.sum() == 98


def test_quaternions_near_unit_are_normalised_and_others_are_no_attitude() -> None:
    header = "time,bx,by,bz,qw,qx,qy,qz"
    good, near = "30000,1,2,0.5,0.5,0.5,0.5", "30000,1,2,0.50025,0.50025,0.50025,0.50025"
    far = {"r1": "30000,1,2,0.51,0.51,0.51,0.51", "r2": "30000,1,2,0,0,0,0", "r3": "30000,1,2,nan,0,0,1"}
    far |= {"r4": "30000,1,2,-9999,0,0,1", "r5": "30000,1,2,1e200,0,0,0"}
    telemetry = read_telemetry(table(header=header, cells=good, r0=near, **far))
    q = telemetry.samples.q_base_gcrf
    assert q is not None
    assert telemetry.quality.quaternions_normalised == 1
    assert telemetry.quality.flags == {"no_attitude": 5}
    np.testing.assert_allclose(q[0], [0.5] * 4, rtol=1e-15)
    assert np.isnan(q[1:6]).all()
    assert telemetry.samples.is_used.all(), "without attitude a sample still serves the scalar methods"


def test_a_missing_reference_flags_the_sample() -> None:
    telemetry = read_telemetry(table(header="time,bx,by,bz,ref_b", cells="30000,1,2,31000", r3="30000,1,2,"))
    assert telemetry.quality.flags == {"no_reference": 1}
    assert not telemetry.samples.is_used[3]


def test_a_missing_position_flags_the_sample_where_no_reference_came() -> None:
    header, cells, hole = "time,bx,by,bz,x_km,y_km,z_km", "30000,1,2,7000,0,0", "30000,1,2,,0,0"
    assert read_telemetry(table(header=header, cells=cells, r3=hole)).quality.flags == {"no_reference": 1}
    with_reference = table(header=f"{header},ref_b", cells=f"{cells},31000", r3=f"{hole},31000")
    assert read_telemetry(with_reference).quality.flags == {}


def test_a_gap_in_the_housekeeping_leaves_the_sample_in() -> None:
    telemetry = read_telemetry(table(header="time,bx,by,bz,temp", cells="30000,1,2,20", r3="30000,1,2,"))
    assert telemetry.quality.flags == {"no_housekeeping": 1}
    assert telemetry.quality.used == 100


@pytest.mark.parametrize("sent_in", sorted(NT_PER_UNIT))
@pytest.mark.parametrize("declared", sorted(NT_PER_UNIT))
def test_a_wrong_unit_is_refused_with_the_right_one_and_the_factor(sent_in: str, declared: str) -> None:
    b = 30_000.0 / NT_PER_UNIT[sent_in]
    body = table(cells=f"{b!r},0,0")
    if sent_in == declared:
        np.testing.assert_allclose(read_samples(body, unit=declared).h_nt[:, 0], 30_000.0, rtol=1e-15)
        return
    factor = NT_PER_UNIT[sent_in] / NT_PER_UNIT[declared]
    with pytest.raises(UnitsError) as caught:
        read_samples(body, unit=declared)
    assert f"look like {sent_in}: {factor:g} times" in caught.value.message
    assert read_samples(body, unit=declared, field_range_nt=None).h_nt[0, 0] == b * NT_PER_UNIT[declared]


def test_readings_that_no_known_unit_explains_are_taken_as_they_are() -> None:
    np.testing.assert_array_equal(read_samples(table(cells="3,0,0")).h_nt[0], [3.0, 0.0, 0.0])


def test_a_reference_in_the_table_decides_about_the_unit() -> None:
    """Readings of 30 nT against a reference of 12 nT are small, not in uT."""
    small = table(header="time,bx,by,bz,ref_bx,ref_by,ref_bz", cells="22,-8,-44,7,-6,-9")
    assert len(read_samples(small)) == 100
    in_ut = table(header="time,bx,by,bz,ref_b", cells="22,-8,-44,45000")
    with pytest.raises(UnitsError, match="look like uT: 1000 times"):
        read_samples(in_ut)


def test_a_unit_is_needed_and_must_be_known() -> None:
    with pytest.raises(UnitsMissingError):
        read_samples(table(), unit="")
    with pytest.raises(UnitsError, match="unknown unit 'gauss'"):
        read_samples(table(), unit="gauss")


def test_the_report_has_span_step_and_gaps() -> None:
    lines = table().split(b"\n")
    body = b"\n".join([*lines[:41], *lines[51:]])
    quality = read_telemetry(body).quality
    assert (quality.span_s, quality.step_s, quality.gaps, quality.longest_gap_s) == (990.0, 10.0, 1, 110.0)
    assert quality.to_dict()["flags"] == {}


def test_overlapping_passes_merge_to_the_single_pass() -> None:
    lines = table(cells="30000,-1,2").split(b"\n")
    first, second = b"\n".join(lines[:61]), b"\n".join([lines[0], *lines[41:]])
    merged = merge_samples([read_samples(second), read_samples(first)])
    whole = read_samples(table())
    used = merged.take(merged.is_used)
    assert used.t_utc.tobytes() == whole.t_utc.tobytes()
    assert used.h_nt.tobytes() == whole.h_nt.tobytes()
    assert len(merged) == 120


def test_merging_fills_what_a_part_lacks_and_flags_it() -> None:
    with_temperature = read_samples(table(header="time,bx,by,bz,temp,ref_b", cells="30000,1,2,20,31000"))
    without = read_samples(table().replace(b"\n16", b"\n15"))
    merged = merge_samples([with_temperature, without])
    assert np.isnan(merged.housekeeping["temp"][:100]).all()
    assert (merged.flags[:100] == (SampleFlag.NO_HOUSEKEEPING | SampleFlag.NO_REFERENCE)).all()
    assert (merged.flags[100:] == 0).all()


@pytest.mark.real_data
def test_bro4_has_2371_usable_samples(bro4_dir: Path) -> None:
    """2411 rows, 40 without the on-board reference, one of them without a reading."""
    columns = {"time": "ts"} | {f"b{axis}": f"extmag_{i}" for i, axis in enumerate("xyz")}
    columns |= {f"ref_eci_{axis}": f"ephem_mageci_{i}" for i, axis in enumerate("xyz")}
    quality = read_telemetry(bro4_dir / "external.csv", columns=columns, unit="mG").quality
    assert (quality.rows, quality.used) == (2411, 2371)
    assert quality.flags["no_reference"] == 40
    assert quality.flags["not_finite"] == 1


@pytest.mark.parametrize("regular", range(10))
def test_the_median_step_is_numpys_however_regular_the_table_is(regular: int) -> None:
    """Ten steps, some of 10 s and the others longer, where the median is between two of them too."""
    steps_s = np.array([10] * regular + [10 + 7 * i for i in range(1, 11 - regular)])
    np.random.default_rng(regular).shuffle(steps_s)
    rows = "".join(f"{t},30000,-1,2\n" for t in 1_600_000_000 + np.concatenate([[0], np.cumsum(steps_s)]))
    assert read_telemetry(f"time,bx,by,bz\n{rows}".encode()).quality.step_s == np.median(steps_s)

"""Calibrations with and without an index: worked sessions, storms, quiet time, records, and whether intervals hold."""

import importlib
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import magcal_core as mc
from magcal_core.errors import IndexMissingError, IndexRangeError, OptionError, TooFewSamplesError
from magcal_core.samples import SampleFlag
from magcal_core.simulation.external_missions import scale_held

DATA = Path(__file__).resolve().parents[1] / "data" / "field"
CASES = json.loads((DATA / "cases.json").read_text())
RUNS = [(case, run) for case in CASES["calibrations"] for run in case["runs"]]
INDEX_OF = {"storm": "rc_2024-05.dat", "quiet": "rc_2021-02.csv"}


@pytest.fixture(scope="module")
def sessions():
    return {case["activity"]: mc.read_samples(DATA / case["file"]) for case in CASES["calibrations"]}


def run_of(sessions, case, run):
    index = [] if run["index"] is None else [DATA / run["index"]]
    return mc.calibrate(sessions[case["activity"]], field=run["field"], index=index)


@pytest.mark.parametrize(("case", "run"), RUNS, ids=[f"{c['activity']} {r['field']}" for c, r in RUNS])
def test_worked_calibrations(sessions, case, run):
    found, tolerance = run_of(sessions, case, run), run["tolerance"]
    for name in ("bias_nt", "scale", "nonorthogonality_deg"):
        np.testing.assert_allclose(getattr(found.parameters, name), run[name], rtol=0, atol=tolerance[name])
    assert found.after.rms_nt == pytest.approx(run["rms_nt"], abs=tolerance["rms_nt"])
    assert found.field_model == run["field"]
    kind = run["field"].partition("+")[2] or "none"
    assert found.to_dict()["external_field"]["kind"] == kind


@pytest.mark.parametrize("case", CASES["calibrations"], ids=lambda case: case["activity"])
def test_an_index_takes_the_scale_error_away(sessions, case):
    runs = {run["field"]: run_of(sessions, case, run) for run in case["runs"]}
    truth = np.array(case["truth"]["scale"])
    error = {name: np.abs(found.parameters.scale - truth).max() for name, found in runs.items()}
    assert error["igrf-14+rc"] <= max(0.15 * error["igrf-14"], 50e-6)
    with_index = runs["igrf-14+rc"]
    assert (np.abs(with_index.parameters.scale - truth) <= 3 * with_index.standard_errors.scale).all()


def test_a_storm_that_the_reference_knows_nothing_of_weakens(sessions):
    plain = mc.calibrate(sessions["storm"], index=DATA / INDEX_OF["storm"])
    assert plain.verdict.grade == "weak"
    assert [reason.code for reason in plain.verdict.reasons] == ["storm"]
    assert any(text.startswith("storm:") and "+rc" in text for text in plain.warnings)
    by_kp = mc.calibrate(sessions["storm"], index=DATA / "kp_2024-05.txt")
    assert [reason.code for reason in by_kp.verdict.reasons] == ["storm"]
    for options in ({"field": "igrf-14+rc", "index": DATA / INDEX_OF["storm"]}, {}):
        assert "storm" not in {reason.code for reason in mc.calibrate(sessions["storm"], **options).verdict.reasons}
    quiet = mc.calibrate(sessions["quiet"], index=DATA / INDEX_OF["quiet"])
    assert quiet.verdict.grade == "accept"
    assert quiet.extras["external_field"]["index_nt"] is not None


def test_an_index_beside_changes_errors_and_not_parameters(sessions):
    plain = mc.calibrate(sessions["quiet"])
    beside = mc.calibrate(sessions["quiet"], index=DATA / INDEX_OF["quiet"])
    np.testing.assert_array_equal(plain.parameters.vector, beside.parameters.vector)
    assert (beside.standard_errors.scale < plain.standard_errors.scale).all()


def test_the_record_has_sources_sizes_and_provenance(sessions):
    index = mc.read_index(DATA / INDEX_OF["storm"])
    record = mc.calibrate(sessions["storm"], field="igrf+rc", index=index).to_dict()
    external = record["external_field"]
    assert set(external) == {"kind", "index_nt", "rms_nt", "interpolated_hours", "mean_samples"}
    assert 300 < external["rms_nt"] < 400
    (one,) = record["provenance"]["indices"]
    assert one == {
        "name": "RC",
        "format": "dtu-rc",
        "sha256": index.sha256,
        "first": "2024-05-07T00:00:00.000000Z",
        "last": "2024-05-14T00:00:00.000000Z",
        "hours": 5,
    }
    assert record["provenance"]["field_file"] is None
    sources = [one["source"] for one in record["uncertainty"]["reference"]]
    assert sources[:3] == ["external_ring", "external_induced", "external_uniform"]
    assert {item["source"] for item in record["error_budget"]} >= {"external", "crust"}
    file = mc.read_field_file(DATA / "core.shc")
    with pytest.raises(OptionError, match="takes no file"):
        mc.calibrate(sessions["storm"], field_file=file)
    with pytest.raises(IndexMissingError):
        mc.calibrate(sessions["storm"], field="igrf-14+rc")
    with pytest.raises(IndexRangeError):
        mc.calibrate(sessions["storm"], field="igrf-14+rc", index=DATA / INDEX_OF["quiet"])


def test_where_the_index_ends_the_mean_may_stand_for_it(sessions):
    other = DATA / INDEX_OF["quiet"]
    gap = mc.calibrate(sessions["storm"], field="igrf-14+rc", index=other, index_gap="mean")
    mean = mc.calibrate(sessions["storm"], field="igrf-14+mean")
    np.testing.assert_allclose(gap.parameters.vector, mean.parameters.vector, rtol=1e-9)
    assert gap.extras["external_field"]["mean_samples"] == len(sessions["storm"])


def test_only_quiet_hours_count_where_it_is_asked_for(sessions):
    hours = [f"2021-02-11T{h:02d}:00:00Z" for h in range(24)]
    dst = [f"{hour},{-100 if h == 7 else 0}" for h, hour in enumerate(hours)]
    kp = [f"{hour},{1 if h < 9 else 3}" for h, hour in enumerate(hours) if h % 3 == 0]
    given = [mc.read_index("\n".join([f"hour,{name}", *rows]).encode()) for name, rows in (("dst_nt", dst), ("kp", kp))]
    quiet = mc.calibrate(sessions["quiet"], index=given, quiet_only=True)
    is_left = quiet.residuals.flags & np.uint16(SampleFlag.NOT_QUIET) > 0
    hour = sessions["quiet"].t_utc.astype("datetime64[h]").astype(int) % 24
    # Dst moves by 100 nT from 6 to 7 h and back to 8 h; Kp is 3 from 9 h on.
    np.testing.assert_array_equal(is_left, (hour == 7) | (hour >= 8))
    assert quiet.rejected == np.count_nonzero(is_left)
    names = {entry["name"] for entry in quiet.to_dict()["provenance"]["indices"]}
    assert names == {"Dst", "Kp"}
    for some in (given[:1], given[1:], []):
        with pytest.raises(IndexMissingError):
            mc.calibrate(sessions["quiet"], index=some, quiet_only=True)
    with pytest.raises(TooFewSamplesError):
        mc.calibrate(sessions["storm"], index=[DATA / "kp_2024-05.txt", DATA / "dst_2024-05.txt"], quiet_only=True)


def rc_of_years():
    """RC of 1997 to 2026 as chaosmagpy brings it along: the instants of the sessions are drawn from it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(str(importlib.import_module("chaosmagpy").__file__)).parent
    return mc.read_index(folder / "lib" / "RC_index.h5")


def test_intervals_of_the_scale_hold_at_every_inclination():
    """Three sessions at each of five inclinations with each field; ``python -m benchmarks external`` has a hundred.

    90 to 100 % are asked for; 84 % of 45 factors, which move together in a session, allows for chance.
    """
    index = rc_of_years()
    for field in ("igrf-14", "igrf-14+mean", "igrf-14+dst", "igrf-14+rc"):
        held = [scale_held(field, index, at, seed) for at in (10.0, 28.0, 52.0, 70.0, 98.0) for seed in range(3)]
        assert np.mean(held) >= 0.84, field

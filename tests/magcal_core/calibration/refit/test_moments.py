"""Refits from the moments of a fit against calibrations of the same samples under the options asked for."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from magcal_core.calibration.refit.moments import MAX_COLUMNS, FitMoments
from magcal_core.calibration.refit.outcome import Refit, RefitOptions
from magcal_core.calibration.refit.refit import refit
from magcal_core.calibration.result import Calibration
from magcal_core.errors import MomentsError, OptionError
from magcal_core.orbit.ephemeris.oem import parse_oem
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.pipeline import calibrate
from magcal_core.samples import Samples
from magcal_core.sensor.model import SensorModel
from magcal_core.sensor.parameters import Parameters
from magcal_core.simulation.missions import draw_orbit
from magcal_core.simulation.telemetry import Disturbances, simulate

START = np.datetime64("2022-01-01", "ns")
SENSOR = SensorModel([2000.0, -1500.0, 800.0], [1.02, 0.97, 1.01], [1.0, -2.0, 1.5])
PER_KELVIN_NT = np.array([5.0, -3.0, 2.0])
OFFSET_S = 0.6
METHODS = ("scalar", "vector")


@cache
def mission() -> tuple[Samples, Sgp4Orbit]:
    """Return telemetry whose bias follows a temperature, with a useless column and a clock that is off."""
    random = np.random.default_rng(3)
    orbit = draw_orbit(random, START)
    disturbed = Disturbances(60.0, time_offset_s=OFFSET_S)
    samples = simulate(orbit, SENSOR, START, 14000.0, 10.0, rate_deg_s=0.5, disturbances=disturbed, seed=1).samples
    n = len(samples)
    warmth = np.cumsum(random.normal(size=n)) / np.sqrt(n) * 10.0
    columns = {"temperature": 290.0 + warmth, "noise": random.normal(size=n)}
    return replace(samples, h_nt=samples.h_nt + warmth[:, None] * PER_KELVIN_NT, housekeeping=columns), orbit


@cache
def calibrated(
    method: str, robust: str = "none", regressors: tuple[str, ...] = (), clock: str = "none", locked: str = "none"
) -> Calibration:
    """Return the mission's calibration with its moments."""
    samples, orbit = mission()
    options = {"method": method, "robust": robust, "regressors": regressors, "time_offset": clock}
    options |= {"locked_terms": locked, "noise_model": "none"}
    return calibrate(samples, [orbit], with_moments=True, **options)


def moments(method: str, robust: str = "none", regressors: tuple[str, ...] = (), clock: str = "none") -> FitMoments:
    """Return the moments of a calibration as a file gives them back."""
    kept = calibrated(method, robust, regressors, clock).moments
    assert kept is not None
    return FitMoments.from_bytes(kept.to_bytes())


def bare(parameters: Parameters) -> np.typing.NDArray[np.float64]:
    """Return the parameters without the clock's offset."""
    return replace(parameters, time_offset_s=None).vector


def distance(found: Refit, whole: Calibration) -> float:
    """Return the largest difference of a parameter, in standard errors of the calibration."""
    difference = bare(found.parameters) - bare(whole.parameters)
    return float(np.max(np.abs(difference) / bare(whole.standard_errors)))


def spread(found: Refit, whole: Calibration) -> float:
    """Return the largest factor between two standard errors of a parameter."""
    ratio = bare(found.standard_errors) / bare(whole.standard_errors)
    return float(np.exp(np.max(np.abs(np.log(ratio)))))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("robust", ["none", "huber", "cauchy"])
def test_a_refit_of_nothing_else_is_the_calibration(method: str, robust: str) -> None:
    found, whole = refit(moments(method, robust), RefitOptions()), calibrated(method, robust)
    # Single precision in the file moves nothing by more than a thousandth of its error; neighbours share a normal
    # matrix, which is 2 % of an error.
    assert distance(found, whole) < 1e-3
    assert spread(found, whole) < 1.02


@pytest.mark.parametrize("method", METHODS)
def test_a_regressor_is_taken_in_as_by_a_calibration(method: str) -> None:
    found, whole = refit(moments(method), RefitOptions(("temperature",))), calibrated(method, "none", ("temperature",))
    # The step is exact for the vector method; |B| bends by less than a hundredth of an error over so small a way.
    assert distance(found, whole) < 0.01
    assert spread(found, whole) < 1.3
    assert found.cross_validated_rms_nt == pytest.approx(whole.cross_validated_rms_nt, rel=0.01)
    np.testing.assert_allclose(
        found.parameters.regressors["temperature"],
        PER_KELVIN_NT,
        atol=4.0 * float(np.max(found.standard_errors.regressors["temperature"])),
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("robust", ["none", "huber", "cauchy"])
def test_a_regressor_is_left_out_as_by_a_calibration(method: str, robust: str) -> None:
    found, whole = refit(moments(method, robust, ("temperature",)), RefitOptions(())), calibrated(method, robust)
    # Under a loss the weights would change with the step, which is known for small ones only.
    assert distance(found, whole) < (0.01 if robust == "none" else 0.15)
    change = {one.parameter: one for one in found.changes}["regressors.temperature[0]"]
    assert (change.after, change.standard_error) == (0.0, 0.0)
    assert change.before == pytest.approx(PER_KELVIN_NT[0], abs=2.0)


@pytest.mark.parametrize("method", METHODS)
def test_auto_takes_what_unseen_blocks_bear_out(method: str) -> None:
    found = refit(moments(method, "huber"), RefitOptions("auto"))
    samples, orbit = mission()
    # A calibration asks for evidence beside every smooth bias as well: the column is given ten times its effect there.
    warmth = samples.housekeeping["temperature"] - 290.0
    stronger = replace(samples, h_nt=samples.h_nt + 9.0 * warmth[:, None] * PER_KELVIN_NT)
    whole = calibrate(stronger, [orbit], method=method, robust="huber", regressors="auto", time_offset="none")
    assert tuple(found.parameters.regressors) == tuple(whole.parameters.regressors) == ("temperature",)
    assert [row.regressors for row in found.ablation if row.is_selected] == [("temperature",)]


@pytest.mark.parametrize("method", METHODS)
def test_the_clock_is_found_as_by_a_calibration(method: str) -> None:
    regressors = ("temperature",)
    found = refit(moments(method, "none", regressors), RefitOptions(time_offset=True))
    whole = calibrated(method, "none", regressors, "estimate")
    told = whole.extras["time_offset"]
    assert isinstance(told, dict)
    assert found.time_offset is not None
    # Over 0.6 s the reference bends by some nT: a fifth of the error of |B|'s offset, and of the axes'.
    assert found.time_offset.offset_s == pytest.approx(told["offset_s"], abs=0.2 * told["standard_error_s"])
    # Of the parameters' errors: with what an external field does to the clock.
    assert found.time_offset.error_s == pytest.approx(whole.standard_errors.time_offset_s, rel=0.1)
    assert found.time_offset.offset_s == pytest.approx(OFFSET_S, abs=4.0 * found.time_offset.error_s)


@pytest.mark.parametrize("method", METHODS)
def test_one_step_of_the_clock_goes_nearly_all_of_the_way_of_half_a_minute(method: str) -> None:
    _, orbit = mission()
    disturbed = Disturbances(20.0, time_offset_s=30.0)
    late = simulate(orbit, SENSOR, START, 14000.0, 10.0, rate_deg_s=0.5, disturbances=disturbed, seed=2).samples
    # Any but the plain fit takes such a clock, or refuses data that show it beyond doubt.
    plain = {"time_offset": "none", "locked_terms": "none", "robust": "none", "noise_model": "none"}
    kept = calibrate(late, [orbit], method=method, with_moments=True, **plain).moments
    assert kept is not None
    found = refit(kept, RefitOptions(time_offset=True)).time_offset
    assert found is not None
    # The second derivative of |B| over 30 s is some 2 % of the first.
    assert found.offset_s == pytest.approx(30.0, rel=0.03)


@pytest.mark.parametrize("method", METHODS)
def test_a_fit_with_a_clock_keeps_it_among_the_unknowns(method: str) -> None:
    regressors = ("temperature",)
    kept, whole = moments(method, "none", regressors, "estimate"), calibrated(method, "none", regressors, "estimate")
    found = refit(kept, RefitOptions())
    assert found.time_offset is not None
    assert found.parameters.time_offset_s == pytest.approx(whole.parameters.time_offset_s, abs=1e-3)
    assert distance(found, whole) < 0.01
    held = refit(kept, RefitOptions(time_offset=False))
    assert held.time_offset is None
    assert held.parameters.time_offset_s == pytest.approx(whole.parameters.time_offset_s, abs=1e-3)


@cache
def by_default(method: str, regressors: tuple[str, ...], clock: str = "auto") -> Calibration:
    """Return the mission's calibration as it comes: beside locked errors, with errors of the reference considered."""
    samples, orbit = mission()
    return calibrate(samples, [orbit], with_moments=True, method=method, regressors=regressors, time_offset=clock)


def kept(whole: Calibration) -> FitMoments:
    """Return the moments of a calibration as a file gives them back."""
    assert whole.moments is not None
    return FitMoments.from_bytes(whole.moments.to_bytes())


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("clock", ["auto", "estimate"])
def test_a_refit_beside_locked_errors_is_the_calibration(method: str, clock: str) -> None:
    whole = by_default(method, ("temperature",), clock)
    found = refit(kept(whole), RefitOptions())
    np.testing.assert_allclose(found.parameters.vector, whole.parameters.vector, rtol=1e-6, atol=1e-6)
    count = found.standard_errors.vector.size
    np.testing.assert_allclose(found.standard_errors.vector, whole.standard_errors.vector[:count], rtol=1e-6)
    if clock == "estimate":
        assert found.time_offset is not None
        assert found.time_offset.error_s == pytest.approx(whole.standard_errors.time_offset_s)
    assert found.warnings == ()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("before", "after"), [((), ("temperature",)), (("temperature",), ())])
def test_a_refit_has_the_locked_and_considered_errors_of_a_calibration(
    method: str, before: tuple[str, ...], after: tuple[str, ...]
) -> None:
    """Other regressors: what a new calibration in its default options says, errors within 5 %."""
    found, whole = refit(kept(by_default(method, before)), RefitOptions(after)), by_default(method, after)
    assert distance(found, whole) < 0.1
    assert spread(found, whole) < 1.05
    # Without what is hidden the errors are a good part of these.
    bare_moments = replace(kept(by_default(method, before)), locked=None, reference=None, trusted=np.zeros((2, 0)))
    small = refit(bare_moments, RefitOptions(after))
    assert float(np.min(bare(small.standard_errors) / bare(whole.standard_errors))) < 0.9


@pytest.mark.parametrize("method", METHODS)
def test_a_clock_asked_of_a_refit_has_the_error_of_a_calibration_s(method: str) -> None:
    """The external field moves a clock too: by |B| alone that is most of its error."""
    regressors = ("temperature",)
    found = refit(kept(by_default(method, regressors)), RefitOptions(time_offset=True))
    whole = by_default(method, regressors, "estimate")
    assert found.time_offset is not None
    assert found.time_offset.error_s == pytest.approx(whole.standard_errors.time_offset_s, rel=0.05)
    assert found.time_offset.offset_s == pytest.approx(
        whole.parameters.time_offset_s, abs=0.1 * found.time_offset.error_s
    )
    assert distance(found, whole) < 0.1
    assert spread(found, whole) < 1.05


def test_moments_of_the_old_form_say_what_their_errors_lack() -> None:
    whole = by_default("scalar", ("temperature",))
    assert whole.moments is not None
    content = replace(whole.moments, locked=None, reference=None).to_bytes()
    with np.load(io.BytesIO(content)) as file:
        parts = {name: file[name] for name in file.files}
    head = json.loads(parts["head"].tobytes()) | {"form": 1}
    parts["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    written = io.BytesIO()
    np.savez(written, **parts)
    found = refit(FitMoments.from_bytes(written.getvalue()), RefitOptions(()))
    assert [text.split(":")[0] for text in found.warnings] == ["hidden_errors_not_kept"]


@pytest.mark.parametrize("method", METHODS)
def test_a_span_left_out_leaves_the_errors_of_a_calibration_without_it(method: str) -> None:
    samples, orbit = mission()
    begin, end = samples.t_utc[300], samples.t_utc[600]
    is_kept = (samples.t_utc < begin) | (samples.t_utc > end)
    whole = calibrate(samples.take(is_kept), [orbit], method=method, regressors=("temperature",))
    found = refit(kept(by_default(method, ("temperature",))), RefitOptions(without=((begin, end),)))
    assert distance(found, whole) < 0.3
    # The session without its middle is held against other blocks and other frequencies.
    assert spread(found, whole) < 1.6


@pytest.mark.parametrize("method", METHODS)
def test_spans_of_time_are_left_out(method: str) -> None:
    samples, orbit = mission()
    begin, end = samples.t_utc[300], samples.t_utc[600]
    is_kept = (samples.t_utc < begin) | (samples.t_utc > end)
    whole = calibrate(samples.take(is_kept), [orbit], method=method, time_offset="none")
    found = refit(moments(method), RefitOptions(without=((begin, end),)))
    # A span's ends lie within blocks of 8 samples, of which a share is taken.
    assert distance(found, whole) < 0.15
    # Errors as under the same choices: the moments are of a fit without errors locked to the orbit.
    plain = {"robust": "none", "noise_model": "none", "time_offset": "none", "locked_terms": "none"}
    assert spread(found, calibrate(samples.take(is_kept), [orbit], method=method, **plain)) < 1.15
    assert found.left_out_share == pytest.approx(300 / len(samples), abs=0.01)
    assert found.samples == pytest.approx(np.count_nonzero(is_kept), abs=10)


def test_moments_from_before_the_fits_own_blocks_had_times_are_cut_more_coarsely() -> None:
    with np.load(io.BytesIO(moments("scalar").to_bytes())) as file:
        parts = {name: file[name] for name in file.files if not name.startswith("own_")}
    written = io.BytesIO()
    np.savez(written, **parts)
    old, new = FitMoments.from_bytes(written.getvalue()), moments("scalar")
    unmoved = [refit(one, RefitOptions()).parameters.vector for one in (old, new)]
    np.testing.assert_array_equal(*unmoved)
    t_utc = mission()[0].t_utc
    found = refit(old, RefitOptions(without=((t_utc[300], t_utc[600]),)))
    assert found.left_out_share == pytest.approx(300 / len(t_utc), abs=0.01)


def test_spans_that_overlap_are_left_out_once() -> None:
    t_utc = mission()[0].t_utc
    parts = ((t_utc[500], t_utc[604]), (t_utc[301], t_utc[550]), (t_utc[301], t_utc[550]))
    found = refit(moments("scalar"), RefitOptions(without=parts))
    whole = refit(moments("scalar"), RefitOptions(without=((t_utc[301], t_utc[604]),)))
    assert found.left_out_share == whole.left_out_share
    np.testing.assert_array_equal(found.parameters.vector, whole.parameters.vector)


@pytest.mark.parametrize("method", METHODS)
def test_bootstrap_agrees_with_that_of_the_samples(method: str) -> None:
    samples, orbit = mission()
    whole = calibrate(samples, [orbit], method=method, time_offset="none", bootstrap=400).extras["bootstrap"]
    assert isinstance(whole, dict)
    found = refit(moments(method), RefitOptions(bootstrap=400, seed=1)).bootstrap
    assert found is not None
    assert found.replicates == 400
    # A standard error of 400 replicates is known to 3.5 %; blocks are drawn in other lengths.
    expected = np.array(whole["standard_errors"]["bias_nt"])
    np.testing.assert_allclose(found.standard_errors.bias_nt, expected, rtol=0.3)


def test_a_column_that_is_not_kept_is_named() -> None:
    with pytest.raises(OptionError, match="no column 'current'; there are temperature, noise"):
        refit(moments("scalar"), RefitOptions(("current",)))


def test_spans_that_leave_next_to_nothing_are_refused() -> None:
    samples, _ = mission()
    with pytest.raises(OptionError, match="less than 10%"):
        refit(moments("scalar"), RefitOptions(without=((samples.t_utc[0], samples.t_utc[-1]),)))
    with pytest.raises(OptionError, match="ends before it begins"):
        refit(moments("scalar"), RefitOptions(without=((samples.t_utc[9], samples.t_utc[3]),)))


def test_no_more_columns_are_kept_than_the_file_has_room_for() -> None:
    samples, orbit = mission()
    random = np.random.default_rng(5)
    many = {f"column {i}": random.normal(size=len(samples)) for i in range(9)}
    found = calibrate(
        replace(samples, housekeeping=many), [orbit], with_moments=True, regressors=("column 8",), time_offset="none"
    ).moments
    assert found is not None
    assert found.columns == ("column 8", *(f"column {i}" for i in range(MAX_COLUMNS - 1)))
    # Six columns beside the locked terms' 45: 2,775 products of 64 blocks in two bytes each, and the equations.
    assert len(found.to_bytes()) < 600_000


def test_a_fit_whose_scale_has_regressors_has_no_moments() -> None:
    samples, orbit = mission()
    regressors = ("temperature", "temperature*h")
    assert calibrate(samples, [orbit], with_moments=True, regressors=regressors).moments is None


def test_a_method_without_a_minimum_has_no_moments() -> None:
    samples, orbit = mission()
    assert calibrate(samples, [orbit], with_moments=True, method="vector-closed-form").moments is None
    assert calibrate(samples, [orbit]).moments is None


@pytest.mark.parametrize("content", [b"", b"PK", b"not a file", b"\x93NUMPY"])
def test_bytes_that_are_no_moments_are_refused(content: bytes) -> None:
    with pytest.raises(MomentsError):
        FitMoments.from_bytes(content)


def test_a_damaged_file_is_refused() -> None:
    content = bytearray(moments("scalar").to_bytes())
    content[len(content) // 2] ^= 0xFF
    with pytest.raises(MomentsError):
        FitMoments.from_bytes(bytes(content))


def test_an_ephemeris_that_ends_with_the_telemetry_leaves_moments_without_a_clock() -> None:
    samples, orbit = mission()
    t_utc = samples.t_utc[:: (len(samples) - 1) // 100]
    r_km, v_km_s = orbit.state_gcrf(t_utc)
    states = [" ".join(map(str, [*r, *v])) for r, v in zip(r_km, v_km_s, strict=True)]
    rows = [f"{str(t)[:26]} {state}" for t, state in zip(t_utc, states, strict=True)]
    text = (
        "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2022-02-20T00:00:00\nORIGINATOR = TEST\nMETA_START\nOBJECT_NAME = A\n"
        "OBJECT_ID = 2020-068H\nCENTER_NAME = EARTH\nREF_FRAME = GCRF\nTIME_SYSTEM = UTC\n"
        f"START_TIME = {str(t_utc[0])[:26]}\nSTOP_TIME = {str(t_utc[-1])[:26]}\nMETA_STOP\n" + "\n".join(rows) + "\n"
    )
    covered = samples.take(samples.t_utc <= t_utc[-1])
    found = calibrate(covered, [parse_oem(text)], with_moments=True).moments
    assert found is not None
    assert not found.has_clock
    with pytest.raises(OptionError, match="no clock"):
        refit(found, RefitOptions(time_offset=True))

"""Worked missions of errors locked to the orbit: an independent generator's, with what its own code makes of them."""

import json

import numpy as np
import pytest

from magcal_core import calibrate
from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit
from magcal_core.telemetry import read_samples

LOCKED = ("heat_nadir", "panel_nadir", "heat_nadir_scalar", "clean_tumble")


@pytest.fixture(scope="module")
def answers(data_dir):
    return json.loads((data_dir / "trust" / "expected.json").read_text())


@pytest.fixture(scope="module")
def found(data_dir, answers):
    """The calibration of a case, made once."""
    made = {}

    def of(name):
        if name not in made:
            folder = data_dir / "trust"
            samples = read_samples(folder / f"{name}.csv", field_range_nt=None)
            orbit = Sgp4Orbit.from_tle((folder / f"{name}.tle").read_text())
            made[name] = calibrate(samples, [orbit], **answers[name]["options"])
        return made[name]

    return of


def truth(answer):
    planted = answer["truth"]
    return np.concatenate([planted["bias_nt"], planted["scale"], planted["nonorthogonality_deg"]])


def worst_direction(got, planted):
    """Largest error of the corrected field over 200 directions at 40 uT, as a share of it."""
    turns = np.arange(200) + 0.5
    z, angle = 1.0 - turns / 100.0, turns * np.pi * (1.0 + np.sqrt(5.0))
    u = np.column_stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z])
    b_nt = 40_000.0 * u
    h_nt = b_nt @ np.array(planted["matrix"]).T + planted["bias_nt"]
    corrected = (h_nt - got.parameters.bias_nt) @ got.correction_matrix.T
    return float(np.linalg.norm(corrected - b_nt, axis=1).max() / 40_000.0)


@pytest.mark.parametrize("name", LOCKED)
def test_every_parameter_is_within_its_errors_and_these_are_as_large_as_they_must_be(found, answers, name):
    """2.5 standard errors of the truth; a factor of 1.6 of the other implementation's standard errors."""
    got, answer = found(name), answers[name]
    errors = got.standard_errors.vector[:9]
    assert np.all(np.abs(got.parameters.vector[:9] - truth(answer)) < 2.5 * errors)
    ratio = errors / np.array(answer["reference"]["standard_errors"])
    assert np.all((ratio > 1.0 / 1.6) & (ratio < 1.6))
    np.testing.assert_allclose(
        got.parameters.vector[:9] / errors, np.array(answer["reference"]["estimate"]) / errors, atol=0.5
    )


@pytest.mark.parametrize("name", LOCKED)
def test_the_families_are_as_probable_and_the_estimate_moves_where_it_must(found, answers, name):
    """Probabilities to 0.05, ratios of held-out residuals to 0.02: the light's steps are taken at other instants."""
    terms, want = found(name).extras["locked_terms"], answers[name]["reference"]
    for family, probability in want["locked_terms"].items():
        assert terms["families"][family]["probability"] == pytest.approx(probability, abs=0.05)
    assert terms["moved"] is want["moved"]
    np.testing.assert_allclose(terms["held_out"], want["held_out"], atol=0.02)
    certain = [warning for warning in found(name).warnings if warning.startswith("bias_locked")]
    assert bool(certain) is want["moved"]


def test_a_clean_mission_is_accepted_and_hardly_pays(found, answers):
    got = found("clean_tumble")
    assert got.verdict.grade == "accept"
    assert got.extras["field_error"] < 0.02
    ratio = got.standard_errors.bias_nt / np.array(answers["clean_tumble"]["today"]["standard_errors_bias_nt"])
    assert np.all(ratio < 1.15)


def test_the_clock_is_found_unasked(found, answers):
    got, planted = found("clock_20s"), answers["clock_20s"]["truth"]
    assert got.parameters.time_offset_s == pytest.approx(planted["clock_and_orbit_offset_s"], abs=1.5)
    off = np.abs(got.parameters.bias_nt - planted["bias_nt"])
    assert np.all(off < 2.5 * got.standard_errors.bias_nt)


def test_soft_iron_gives_the_full_matrix(found, answers):
    got, planted = found("soft_iron"), answers["soft_iron"]["truth"]
    errors = np.array(got.extras["matrix_standard_errors"])
    assert np.all(np.abs(got.matrix - np.array(planted["matrix"])) < 2.5 * errors)
    assert got.extras["parameters_of"] == "full"
    assert [warning for warning in got.warnings if warning.startswith("misaligned")]
    assert got.verdict.grade == "accept"
    assert worst_direction(got, planted) < 0.01
    ratio = errors / np.array(answers["soft_iron"]["reference"]["standard_errors"])[:, :3]
    assert np.all((ratio > 1.0 / 1.7) & (ratio < 1.7))


def test_a_transfer_orbit_is_calibrated_where_the_field_is(found, answers):
    got = found("gto")
    assert [warning for warning in got.warnings if warning.startswith("far_samples_left_out")]
    assert worst_direction(got, answers["gto"]["truth"]) < 0.03
    assert "many_rejected" not in [reason.code for reason in got.verdict.reasons]


def test_the_temperature_is_taken_and_no_other_column(found):
    got = found("auto_heat")
    assert tuple(got.parameters.regressors) == ("temperature",)
    (taken,) = [row for row in got.extras["ablation"] if row["selected"]]
    assert taken["log_evidence"] > 8.0
    assert taken["log_evidence"] > taken["surrogate_max"] + 3.0


@pytest.mark.parametrize("turned", ["inverse", "scalar last", "both"])
def test_quaternions_that_are_read_wrongly_are_named(data_dir, answers, turned):
    """The right file is not suspected; each wrong one ends in an error or a reason that names its reading."""
    from dataclasses import replace

    from magcal_core.errors import MagcalError

    folder = data_dir / "trust"
    samples = read_samples(folder / "heat_nadir.csv")
    orbit = Sgp4Orbit.from_tle((folder / "heat_nadir.tle").read_text())
    q = samples.q_base_gcrf
    if turned != "inverse":
        q = np.roll(q, -1, axis=1)
    if turned != "scalar last":
        q = q * ([1.0, -1.0, -1.0, -1.0] if turned == "inverse" else [-1.0, -1.0, -1.0, 1.0])
    try:
        got = calibrate(replace(samples, q_base_gcrf=q), [orbit], method="vector")
        said = " ".join(f"{reason.code} {reason.text}" for reason in got.verdict.reasons)
    except MagcalError as error:
        said = str(error)
    for word in ("inverse",) if turned == "inverse" else ("scalar-last",):
        assert word in said

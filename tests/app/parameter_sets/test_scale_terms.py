"""A set whose scale follows a temperature, at work: over HTTP, on telemetry, in what flight software is given."""

from dataclasses import replace

import numpy as np
import pytest

from app.parameter_sets.correction import Correction
from app.parameter_sets.worked_example import B_NT, formula, worked
from magcal_core.errors import TelemetryFormatError
from magcal_core.simulation.dekart_mission import SESSIONS, simulated, tle_text
from magcal_core.telemetry import write_samples
from tests.app.monitoring.test_monitoring import calibrated

SLOPES = np.array([4e-4, -6e-4, 3e-4])
DRIFT_NT = np.array([5.0, -8.0, 3.0])
TERMS = ["temperature", "temperature*h"]


def warmed():
    made = simulated(SESSIONS[1])
    t_s = (made.samples.t_utc - made.samples.t_utc[0]) / np.timedelta64(1, "s")
    temperature = 5.0 + 15.0 * np.sin(2 * np.pi * t_s / 4000.0)
    h_nt = (made.samples.h_nt + temperature[:, None] * DRIFT_NT) / (1.0 - temperature[:, None] * SLOPES)
    return replace(made.samples, h_nt=h_nt, housekeeping={"temperature": temperature}), made


RECORD = {
    "parameters": {
        "bias_nt": [2807.5, -2056.25, -2070.625],
        "scale": [1.024175, 0.988788, 1.026907],
        "nonorthogonality_deg": [-4.22, -2.133, 8.504],
        "regressors": {"temperature": DRIFT_NT.tolist(), "temperature*h": SLOPES.tolist()},
    }
}


def test_a_correction_takes_the_terms_off_and_puts_them_back():
    """The truth as a record: corrected readings are the field and its noise, and the way back is exact to rounding."""
    samples, made = warmed()
    corrected = Correction.of(RECORD).apply(samples)
    plain = SESSIONS[1].sensor.correct(made.samples.h_nt)
    np.testing.assert_allclose(corrected.h_nt, plain, atol=1e-7)
    np.testing.assert_allclose(Correction.of(RECORD).unapply(corrected).h_nt, samples.h_nt, rtol=0.0, atol=1e-9)


def test_telemetry_without_the_column_is_refused():
    samples, _ = warmed()
    with pytest.raises(TelemetryFormatError) as refused:
        Correction.of(RECORD).apply(replace(samples, housekeeping={}))
    assert [fault.where for fault in refused.value.faults] == ["column temperature"]


def test_the_worked_reading_follows_the_formula():
    terms = RECORD["parameters"]["regressors"]
    got = worked(SESSIONS[1].sensor, terms)
    raw = np.array(got.raw_nt)
    offset = SESSIONS[1].sensor.bias_nt + DRIFT_NT * 1.0 + SLOPES * 1.0 * raw
    np.testing.assert_allclose(got.corrected_nt, np.linalg.inv(SESSIONS[1].sensor.matrix) @ (raw - offset), rtol=1e-12)
    np.testing.assert_allclose(got.corrected_nt, B_NT, atol=0.1)
    assert "regressors.temperature*h * column temperature * raw" in formula("exact", list(terms))


def test_a_job_estimates_the_terms_and_everything_downstream_has_them(api, satellite):
    samples, _ = warmed()
    api.post(f"/satellites/{satellite}/orbits", content=tle_text(), headers={"content-type": "text/plain"})
    content = write_samples(samples, "csv")
    answer = api.post(
        f"/satellites/{satellite}/sessions",
        params={"magnetometer": "mgm"},
        content=content,
        headers={"content-type": "text/csv"},
    )
    session_id = answer.raise_for_status().json()["id"]
    found = calibrated(api, [session_id], regressors=TERMS)
    errors = np.array(found["standard_errors"]["regressors"]["temperature*h"])
    away = np.array(found["parameters"]["regressors"]["temperature*h"]) - SLOPES
    assert np.abs(away / errors).max() < 4.0
    assert errors.max() < 1e-4
    for form in ("json", "yaml", "csv", "c"):
        text = api.get(f"/parameter-sets/{found['id']}/export", params={"format": form}).raise_for_status().text
        assert "temperature*h" in text or "TEMPERATURE_H" in text
    exported = api.get(f"/parameter-sets/{found['id']}/export", params={"format": "json"}).json()
    example = exported["worked_example"]
    raw, regressors = np.array(example["raw_nt"]), exported["parameters"]["regressors"]
    offset = np.array(exported["parameters"]["bias_nt"]) + regressors["temperature"] + regressors["temperature*h"] * raw
    corrected = np.array(exported["correction_matrix"]) @ (raw - offset)
    np.testing.assert_allclose(corrected, example["corrected_nt"], rtol=1e-9)
    judged = api.get(f"/sessions/{session_id}/monitoring", params={"parameter_set": found["id"]})
    assert judged.raise_for_status().json()["grade"] == "agrees"

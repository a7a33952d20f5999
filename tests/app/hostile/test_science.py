"""Telemetry that reads well and cannot be true, or cannot be used (B12, B14, B15, B25)."""

from __future__ import annotations

import numpy as np
import pytest

from magcal_core.simulation.dekart_mission import SESSIONS, simulated
from magcal_core.telemetry import write_samples

HEADER = "time,bx,by,bz,ref_b\n"


def table(h_nt: np.ndarray, b_nt: np.ndarray) -> str:
    rows = (
        f"2026-01-01T{i // 60:02d}:{i % 60:02d}:00Z,{h[0]},{h[1]},{h[2]},{b}\n"
        for i, (h, b) in enumerate(zip(h_nt, b_nt, strict=True))
    )
    return HEADER + "".join(rows)


def along_one_axis() -> str:
    b = np.linspace(30_000, 45_000, 60)
    return table(b[:, None] * [1.0, 0.0, 0.0], b)


def in_a_plane() -> str:
    angle = np.linspace(0, 6, 200)
    b = np.full(200, 40_000.0)
    return table(b[:, None] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1), b)


def without_motion() -> str:
    b = np.full(100, 40_000.0)
    return table(b[:, None] * [0.6, 0.0, 0.8], b)


def five_samples() -> str:
    return "".join(in_a_plane().splitlines(keepends=True)[:6])


@pytest.mark.parametrize("content", [along_one_axis, in_a_plane, without_motion, five_samples])
@pytest.mark.parametrize("method", ["scalar", "scalar-hooke-jeeves"])
def test_what_cannot_be_observed_is_said_and_no_number_is_invented(send, finished, content, method):
    """The job fails with a code of estimation, or with the input's fault where it has a name; there is no number."""
    job = finished(send(content()).raise_for_status().json()["id"], method=method)
    assert job["state"] == "failed", job
    known = {"not_observable", "no_excitation", "coplanar_field", "dead_axis", "insufficient_samples", "wrong_input"}
    assert job["error"]["code"] in known, job["error"]
    assert job["result"] is None
    assert job["attempts"] == 1


def test_the_verdict_of_wrong_axes_is_never_accept(send, send_orbit, finished, api):
    """A left-handed permutation of the axes under a vector method: suspected or refused, with the better candidate."""
    samples = simulated(SESSIONS[0], 300).samples
    swapped = samples.h_nt[:, [1, 0, 2]]
    from dataclasses import replace

    from magcal_core.simulation.dekart_mission import tle_text

    send_orbit(tle_text()).raise_for_status()
    content = write_samples(replace(samples, h_nt=swapped), "csv")
    answer = send(content)
    if answer.status_code == 422:
        assert "frame" in answer.json()["code"]
        return
    job = finished(answer.json()["id"], method="vector")
    if job["state"] == "failed":
        assert job["error"]["status"] == 422
        return
    found = api.get(f"/parameter-sets/{job['result']['parameter_set_id']}").json()
    said = [*found["warnings"], *found["verdict"]["reasons"]]
    assert found["verdict"]["grade"] != "accept"
    assert any("frame_suspect" in one for one in said), said


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"time": ["1850-01-01T00:00:00Z"], "position_km": [[7000.0, 0, 0]]}, 422),
        ({"time": ["2035-01-01T00:00:00Z"], "position_km": [[7000.0, 0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[0.0, 0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[5871.2, 0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[1e300, 1e300, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[42164.0, 0, 0]]}, None),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[6371.2, 0, 0]]}, 200),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[0.0, 0, 7000.0], [0.0, 0.0, -7000.0]]}, 422),
        ({"time": ["2026-01-01T00:00:00"], "position_km": [[7000.0, 0, 0]]}, 422),
        ({"time": [], "position_km": []}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[7000.0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [["7000", 0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[True, 0, 0]]}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[7000, 0, 0]], "model": "igrf-99"}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[7000, 0, 0]], "max_degree": 14}, 422),
        ({"time": ["2026-01-01T00:00:00Z"], "position_km": [[7000, 0, 0]], "frame": "NED"}, 422),
    ],
)
def test_the_field_is_computed_where_the_model_holds_and_nowhere_else(api, body, status):
    answer = api.post("/field", json=body)
    assert answer.status_code in ({200, 422} if status is None else {status}), answer.text
    if answer.status_code == 200:
        assert np.isfinite(answer.json()["field_nt"]).all()


@pytest.mark.parametrize("time", ["0001-06-01T00:00:00Z", "2500-06-01T00:00:00Z", "9999-06-01T00:00:00Z"])
def test_a_time_that_nanoseconds_do_not_reach_is_no_time_of_the_model(api, time):
    """584.5 years too late is not 1915, for which the model has a field."""
    answer = api.post("/field", json={"time": [time], "position_km": [[6871.2, 0.0, 0.0]]})
    assert (answer.status_code, answer.json()["code"]) == (422, "model_range")


def test_the_field_at_the_poles_is_finite_and_continuous_to_a_nanotesla(api):
    """A metre from the axis, on either side: the field changes by far less than 1 nT."""
    places = [[x, 0.0, z] for z in (6871.2, -6871.2) for x in (-1e-3, 0.0, 1e-3)]
    body = {"time": ["2026-01-01T00:00:00Z"] * 6, "position_km": places}
    field = np.array(api.post("/field", json=body).raise_for_status().json()["field_nt"]).reshape(2, 3, 3)
    assert np.isfinite(field).all()
    assert np.abs(np.diff(field, axis=1)).max() < 1.0

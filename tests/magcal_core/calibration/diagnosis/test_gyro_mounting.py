"""Mounting and handedness from gyros: planted rotations come back within their errors, or are refused by name."""

import numpy as np
import pytest

from magcal_core.attitude.rotation import attitude_matrix, from_rotation_vector, unit
from magcal_core.calibration.diagnosis.gyro_mounting import GyroSession, cube_turns, gyro_mounting


def turning(seed, *, n=700, step_s=10.0, rate_deg_s=0.76, noise_deg_s=0.01, hand=1.0):
    """A free body whose gyros and magnetometer see one motion; R, bias and noise drawn; the attitude in fine steps."""
    rng = np.random.default_rng([seed, 5])
    moments, fine = np.array([0.097, 0.078, 0.031]), max(round(step_s), 1)
    rate = np.deg2rad(rate_deg_s) * unit(rng.normal(size=3))
    attitude, dt = np.linalg.qr(rng.normal(size=(3, 3)))[0], step_s / fine
    attitude *= np.sign(np.linalg.det(attitude))
    attitudes, rates = np.empty((n, 3, 3)), np.empty((n, 3))
    for i in range(n):
        attitudes[i], rates[i] = attitude, rate
        for _ in range(fine):
            half = rate + 0.5 * dt * np.cross(moments * rate, rate) / moments
            attitude = attitude_matrix(from_rotation_vector(half * dt)) @ attitude
            rate = rate + dt * np.cross(moments * half, half) / moments
    t_s = step_s * np.arange(n)
    u = 2 * np.pi * t_s / 5700.0
    place = np.c_[np.cos(u), np.sin(u) * 0.3, np.sin(u) * 0.954]
    dipole = np.c_[0.17 * np.cos(7.3e-5 * t_s), 0.17 * np.sin(7.3e-5 * t_s), np.full(n, -0.985)]
    b_nt = 23000.0 * (3 * np.sum(place * dipole, axis=1, keepdims=True) * place - dipole)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    bias = np.deg2rad(rng.uniform(-0.05, 0.05, 3))
    x_nt = hand * np.einsum("ij,njk,nk->ni", turn, attitudes, b_nt) + 60.0 * rng.normal(size=(n, 3))
    measured = rates + bias + np.deg2rad(noise_deg_s) * rng.normal(size=(n, 3))
    return GyroSession(t_s, x_nt, b_nt, measured, np.ones(n)), turn, bias


def off_deg(found, turn):
    cosine = (np.trace(found.rotation @ turn.T) - 1.0) / 2.0
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_a_planted_rotation_bias_and_handedness_come_back(hand):
    """Some tenths of a degree; a session that spins nearly about one axis knows less, and says so."""
    for seed in range(2):
        session, turn, bias = turning(seed, hand=hand)
        found = gyro_mounting(session)
        assert found.state == "resolved", found.to_dict()
        assert off_deg(found, turn) < 1.5
        assert found.handedness == ("right" if hand > 0 else "left")
        assert found.handedness_ratio > 10
        assert np.all(np.abs(found.bias_deg_s - np.rad2deg(bias)) < 5 * found.bias_errors_deg_s)
        assert off_deg(found, turn) < 5 * np.linalg.norm(found.standard_errors_deg)


def test_gaps_and_readings_that_do_not_count_are_no_harm():
    session, turn, _ = turning(7, n=900)
    keep = np.ones(900, dtype=bool)
    keep[300:340] = keep[610:615] = False
    x_nt, weights = session.x_nt[keep].copy(), np.ones(int(keep.sum()))
    bad = np.random.default_rng(1).choice(len(weights), 150, replace=False)
    x_nt[bad], weights[bad] = 1e5, 0.0
    part = GyroSession(session.t_s[keep], x_nt, session.b_nt[keep], session.rate_rad_s[keep], weights)
    found = gyro_mounting(part)
    assert found.state == "resolved"
    assert off_deg(found, turn) < 0.8


@pytest.mark.parametrize(("rate_deg_s", "n"), [(0.02, 1400), (0.005, 1400)])
def test_a_satellite_that_hardly_turns_is_refused_by_name(rate_deg_s, n):
    found = gyro_mounting(turning(3, n=n, step_s=1.0, rate_deg_s=rate_deg_s)[0])
    assert found.state == "refused"
    assert found.reason in ("too_slow", "ambiguous", "uncertain", "few_windows")
    assert found.rotation is None


def test_the_cube_has_24_turns():
    turns = np.array(cube_turns())
    assert turns.shape == (24, 3, 3)
    assert np.allclose(np.linalg.det(turns), 1.0)
    assert len(np.unique(turns.reshape(24, 9), axis=0)) == 24

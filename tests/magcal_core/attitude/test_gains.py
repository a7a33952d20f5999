import numpy as np
import pytest

from magcal_core.attitude.circular import CircularOrbit
from magcal_core.attitude.gains import damping_ratio, efold_s, field_turning, growth_rate_per_s, propose_gains
from magcal_core.attitude.plant import Body, inertia_matrix
from magcal_core.attitude.scenario import Gains
from magcal_core.errors import InputError
from magcal_core.field.models import field_model

DIPOLE = field_model("dipole")
TAU_S = np.array([50.0, 100.0, 200.0, 300.0, 400.0, 600.0, 900.0, 1500.0])
FLOQUET_S = {
    5.0: [483855, 244205, 126356, 88969, 71729, 57464, 53013, 60455],
    20.0: [36040, 18087, 9163, 6258, 4881, 3745, 3563, 4631],
    45.0: [11413, 5644, 2682, 1607, 956, 1285, 1606, 2494],
    62.0: [8434, 4131, 1866, 900, 1023, 1574, 1683, 2809],
    97.7: [7263, 3533, 1528, 597, 1248, 1558, 1792, 2987],
}
"""Slowest Floquet mode of the linearised loop by inclination, deg (docs/attitude.md)."""


def inclined(inclination_deg):
    return CircularOrbit(inclination_rad=float(np.deg2rad(inclination_deg)))


@pytest.mark.parametrize("inclination_deg", FLOQUET_S)
def test_efold_of_the_slowest_mode_is_the_known_one(inclination_deg):
    """0.3 %: the table comes from a coarser integration."""
    np.testing.assert_allclose(efold_s(inclined(inclination_deg), DIPOLE, TAU_S), FLOQUET_S[inclination_deg], rtol=3e-3)


@pytest.mark.parametrize(("inclination_deg", "turning"), [(62.0, 1.93), (90.0, 2.26), (0.0, 0.0)])
def test_the_fields_turning_is_the_known_one(inclination_deg, turning):
    orbit = inclined(inclination_deg)
    assert field_turning(orbit, DIPOLE) / orbit.rate_rad_s**2 == pytest.approx(turning, rel=0.01, abs=1e-9)


GROWTH = [  # kp, tau s, damping ratio, measured and predicted growth, 1e-5 / s
    (0.05, 50.0, 0.44, 3.02, 3.31),
    (0.05, 57.0, 0.50, -0.38, -0.20),
    (0.05, 65.0, 0.57, -3.81, -3.73),
    (0.05, 80.0, 0.71, -9.47, -9.45),
    (0.2, 20.0, 0.35, 4.61, 4.73),
    (0.2, 40.0, 0.71, -4.71, -4.73),
]


@pytest.mark.parametrize("case", GROWTH, ids=str)
def test_rotation_about_the_field_grows_below_half_of_the_damping_ratio(fly, case):
    """The nonlinear simulation over five orbits; 0.02e-5 / s is the last digit of the known figures and a bit."""
    kp, tau_s, zeta, measured, predicted = case
    gains, orbit = Gains(kp, kp * tau_s), inclined(62.0)
    result = fly(
        start=(0.0, 0.0, 0.1), inertia_kg_m2=(80.0, 80.0, 80.0), kp=kp, kd=kp * tau_s, duration_s=5.2 * orbit.period_s
    )
    at = np.interp([orbit.period_s, 5.0 * orbit.period_s], result.t_s, result.error_deg)
    seen = np.log(at[1] / at[0]) / (4.0 * orbit.period_s)
    assert damping_ratio(gains, 80.0) == pytest.approx(zeta, abs=0.006)
    assert 1e5 * seen == pytest.approx(measured, abs=0.03)
    assert 1e5 * growth_rate_per_s(field_turning(orbit, DIPOLE), gains, 80.0) == pytest.approx(predicted, abs=0.05)


def test_proposed_gains_settle_faster_than_the_papers(fly):
    proposal = propose_gains(inclined(62.0), Body(), DIPOLE)
    gains = {"kp": proposal.gains.kp_nm, "kd": proposal.gains.kd_nms}
    assert proposal.damping_ratio > 1.0
    assert proposal.efold_s < 900.0
    spec = {"start": (10.0, 20.0, 30.0), "duration_s": 10_000.0, "dt_s": 2.0}
    assert fly(**spec, **gains).error_deg[-1] < 0.1 * fly(**spec).error_deg[-1]


def test_a_small_satellite_gets_gains_that_its_control_period_allows():
    """A 3U CubeSat with wheels of 1 mNm: kd dt / J stays at 1 at most, and the loop converges in simulation."""
    body = Body(inertia_matrix((0.04, 0.04, 0.008)), torque_limit_nm=1e-3, momentum_limit_nms=0.01)
    gains = propose_gains(inclined(97.7), body, DIPOLE, dt_s=0.5).gains
    assert gains.kd_nms * 0.5 / 0.008 <= 1.0 + 1e-9
    assert gains.kp_nm <= 1e-3


def test_nothing_converges_on_the_equator_of_a_dipole_and_the_proposal_says_so():
    proposal = propose_gains(inclined(0.0), Body(), DIPOLE)
    assert not proposal.converges
    assert proposal.to_dict()["efold_s"] is None


def test_wheels_too_weak_for_the_body_are_named():
    with pytest.raises(InputError, match="too weak"):
        propose_gains(inclined(62.0), Body(inertia_matrix((1e9, 1e9, 1e9)), torque_limit_nm=1e-3), DIPOLE)


def test_a_tau_that_the_integration_cannot_follow_is_refused():
    with pytest.raises(InputError, match="tau must be above"):
        efold_s(inclined(62.0), DIPOLE, np.array([1.0]))


@pytest.mark.parametrize("wrong", [(0.0, 20.0), (0.05, -1.0), (np.nan, 1.0)])
def test_gains_that_are_not_positive_are_refused(wrong):
    with pytest.raises(InputError):
        Gains(*wrong)

"""Where an OPM says that a satellite is, against satkit: its frames, its forces and its integrator."""

import numpy as np
import pytest
import satkit

from magcal_core.orbit.sources import parse_sources

T0 = np.datetime64("2024-05-11T01:02:03", "ns")
R_KM = np.array([6861.897826, -934.3811016, -14.66851920])
V_KM_S = np.array([-0.1222573311, -1.009655310, 7.525523775])
SECONDS_AHEAD = {"UTC": 0, "GPS": 18, "TAI": 37}


def at(t_utc: np.datetime64) -> satkit.time:
    return satkit.time(np.datetime_as_string(t_utc, unit="us") + "Z")


def in_frame(frame: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the state in a frame, by satkit; km and km/s."""
    if frame == "ITRF2014":
        r_m, v_m_s = satkit.frametransform.gcrf_to_itrf_state(R_KM * 1e3, V_KM_S * 1e3, at(T0))
        return np.asarray(r_m) / 1e3, np.asarray(v_m_s) / 1e3
    return R_KM, V_KM_S


@pytest.mark.usefixtures("offline_satkit")
@pytest.mark.parametrize(("frame", "system"), [("GCRF", "UTC"), ("ICRF", "TAI"), ("ITRF2014", "GPS")])
def test_the_position_an_opm_leads_to_is_satkits(frame: str, system: str) -> None:
    """At its epoch and two hours before and behind it, Earth-fixed; both frames are within 1 cm."""
    r_km, v_km_s = in_frame(frame)
    head = {
        "OBJECT_NAME": "X", "OBJECT_ID": "2024-001A", "CENTER_NAME": "EARTH", "REF_FRAME": frame, "TIME_SYSTEM": system,
        "EPOCH": np.datetime_as_string(T0 + np.timedelta64(SECONDS_AHEAD[system], "s"), unit="ms"),
    }  # fmt: skip
    state = zip(("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"), (*r_km, *v_km_s), strict=True)
    lines = [
        *(f"{name} = {value}" for name, value in head.items()),
        *(f"{name} = {value:.12g}" for name, value in state),
    ]
    (source,) = parse_sources("\n".join(["CCSDS_OPM_VERS = 2.0", *lines]))
    settings = satkit.propsettings(
        gravity_degree=12, gravity_order=12, gravity_model=satkit.gravmodel.egm96, tide_model=satkit.tidemodel.none,
        use_relativistic_correction=False, use_spaceweather=False,
    )  # fmt: skip
    for minutes in (0, 120, -120):
        then = T0 + np.timedelta64(minutes, "m")
        end = satkit.propagate(np.concatenate([R_KM, V_KM_S]) * 1e3, at(T0), end=at(then), propsettings=settings).state
        true_km = satkit.frametransform.qgcrf2itrf(at(then)).to_rotation_matrix() @ end[:3] / 1e3
        off_m = 1e3 * np.linalg.norm(source.orbit.position_itrf_km(np.array([then]))[0] - true_km)
        assert off_m < 0.05

import json

import numpy as np
import pytest

from magcal_core.attitude.options import SERIES_POINTS, RomOptions, attitude_job
from magcal_core.errors import OptionError

PARAMETERS = {"bias_nt": [1.0, 2.0, 3.0], "scale": [1.0, 1.1, 0.9], "nonorthogonality_deg": [0.1, 0.2, 0.3]}


def test_options_survive_their_own_record():
    options = RomOptions.from_dict(
        {
            "start": [10, 20, 30],
            "epoch": "2026-03-01T12:00:00Z",
            "turn": [1, 2, 3],
            "sensor": PARAMETERS,
            "field": "igrf",
        }
    )
    record = json.loads(json.dumps(options.to_dict()))
    assert RomOptions.from_dict(record).to_dict() == record
    assert record["start_deg"] == [10.0, 20.0, 30.0]


def test_a_whole_parameter_set_is_a_sensor():
    options = RomOptions.from_dict({"sensor": {"id": "x", "parameters": PARAMETERS}, "corrected_with": PARAMETERS})
    np.testing.assert_allclose(options.sensor.matrix, options.corrected_with.matrix, atol=0)


@pytest.mark.parametrize(
    ("spec", "where"),
    [
        ({"altitude": 500}, "altitude"),
        ({"inclination_deg": 181}, "inclination_deg"),
        ({"inclination_deg": "62"}, "inclination_deg"),
        ({"duration_s": float("nan")}, "duration_s"),
        ({"duration_s": 1e7, "dt_s": 0.1}, "scenario"),
        ({"start": [1, 2]}, "start_deg"),
        ({"start": [1, 2, True]}, "start_deg"),
        ({"form": "original"}, "form"),
        ({"start_rate": 1}, "start_rate"),
        ({"guard": 1}, "guard"),
        ({"seed": 1.5}, "seed"),
        ({"epoch": "yesterday"}, "epoch"),
        ({"epoch": "2020-01-01T00:00:00"}, "epoch"),
        ({"epoch": "2020-13-01T00:00:00Z"}, "epoch"),
        ({"field": "none"}, "scenario"),
        ({"field": 3}, "field"),
        ({"inertia_kg_m2": [1, 1, 5]}, "inertia_kg_m2"),
        ({"sensor": {"bias_nt": [0, 0, 0]}}, "sensor"),
        ({"sensor": "dekart"}, "sensor"),
        ({"sensor": PARAMETERS | {"scale": [0, 1, 1]}}, "sensor.scale"),
        ({"kp": 0}, "kp_nm"),
        ({"kd": None}, "kd_nms"),
    ],
)
def test_what_cannot_be_is_refused_by_name(spec, where):
    with pytest.raises(OptionError) as caught:
        RomOptions.from_dict(spec)
    assert where in [fault.where for fault in caught.value.faults]


def test_an_epoch_in_any_zone_is_the_same_instant():
    options = RomOptions.from_dict({"epoch": "2026-03-01T15:00:00+03:00"})
    assert options.epoch == "2026-03-01T12:00:00.000000Z"
    assert options.orbit().epoch_utc == np.datetime64("2026-03-01T12:00:00")


def test_every_fault_is_named_at_once():
    with pytest.raises(OptionError) as caught:
        RomOptions.from_dict({"kp": -1, "form": "x", "nonsense": 1})
    assert {fault.where for fault in caught.value.faults} == {"kp_nm", "form", "nonsense"}


def test_proposed_gains_take_the_place_of_the_given_ones():
    options = RomOptions.from_dict({"use_proposed_gains": True, "kp": 1.0})
    assert options.scenario().gains == options.proposal().gains


def test_the_job_answers_with_summary_gains_options_and_a_thinned_series():
    found = attitude_job({"start": [110, -130, 170]})
    assert found["settling_s"]["5"] == pytest.approx(3380.0, rel=0.03)
    assert found["gains"] == {"kp_nm": 0.05, "kd_nms": 20.0, "tau_s": 400.0}
    assert found["options"]["start_deg"] == [110.0, -130.0, 170.0]
    series = found["series"]
    assert {len(column) for column in series.values()} == {len(series["t_s"])}
    assert 1000 < len(series["t_s"]) <= SERIES_POINTS
    assert max(series["error_deg"]) == pytest.approx(80.947, abs=1e-3)
    assert json.loads(json.dumps(found)) == found

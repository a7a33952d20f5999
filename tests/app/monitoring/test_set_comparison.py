"""Two sets in a word: same, differs or cannot tell, on sets whose difference is known."""

from __future__ import annotations

from copy import deepcopy

import pytest

from tests.app.test_trends import keep
from tests.magcal_core.calibration.sessions.histories import history


@pytest.fixture(scope="module")
def base() -> dict:
    """A set with errors of some 20 nT."""
    return history(5, 1, walk_nt=0.0, noise_nt=(20.0, 20.0)).sets[0] | {"status": "candidate"}


def moved(record: dict, bias_nt: float, *, errors: float = 1.0) -> dict:
    """Return the set with its second bias moved, and its errors so many times as large."""
    other = deepcopy(record)
    other["parameters"]["bias_nt"][1] += bias_nt
    other["covariance"] = [[value * errors**2 for value in row] for row in other["covariance"]]
    return other


@pytest.fixture
def kept(service, satellite):
    """Store records of the satellite's magnetometer; return their ids."""

    def store(*records: dict, magnetometer: str = "mgm") -> list[str]:
        place = {"satellite_id": satellite, "magnetometer_id": magnetometer}
        with service.database.write() as session:
            return [keep(session, place, one) for one in records]

    return store


def compared(api, one: str, other: str) -> dict:
    return api.get(f"/parameter-sets/{one}/comparison", params={"other": other}).raise_for_status().json()


def test_a_large_step_differs_and_the_parameter_is_named_with_its_sigmas(api, kept, base):
    """5,000 nT on one axis: 1 % of 40,000 nT is the limit; the sigmas are the step over the root of both variances."""
    first, second = kept(base, moved(base, 5000.0))
    found = compared(api, second, first)
    expected = 5000.0 / (2.0 * base["covariance"][1][1]) ** 0.5
    assert (found["word"], found["parameter"]) == ("differs", "bias_nt[1]")
    assert found["sigmas"] == pytest.approx(expected, rel=1e-6)
    assert f"bias_nt[1] differs most, by +5000, {expected:.1f} sigma" in found["text"]
    assert found["field_change_nt"] > found["limit_nt"] == 400.0
    back = compared(api, first, second)
    assert (back["word"], back["differences"][0]["difference"]) == ("differs", -5000.0)


def test_what_is_significant_and_too_little_to_matter_is_the_same(api, kept, base):
    """150 nT at errors of 20 nT is 5 sigma, and less than the limit of 400 nT."""
    first, second = kept(base, moved(base, 150.0))
    found = compared(api, second, first)
    assert (found["word"], found["parameter"]) == ("same", "bias_nt[1]")
    assert found["sigmas"] > 4.0
    assert compared(api, first, first)["word"] == "same"


def test_errors_beyond_the_limit_cannot_tell(api, kept, base):
    first, second = kept(base, moved(base, 300.0, errors=40.0))
    found = compared(api, second, first)
    assert found["word"] == "cannot_tell"
    assert "the errors are too large" in found["text"]
    assert found["field_change_error_nt"] * 1.96 > found["limit_nt"]


def test_sets_of_other_kinds_magnetometers_or_without_errors_cannot_be_told(api, kept, satellite, base):
    api.post(f"/satellites/{satellite}/magnetometers", json={"id": "second", "unit": "nT"}).raise_for_status()
    vector = base | {"method": "vector"}
    broken = base | {"covariance": [[-value for value in row] for row in base["covariance"]]}
    first, of_components, without = kept(base, vector, broken)
    (elsewhere,) = kept(base, magnetometer="second")
    for other, why in ((of_components, "kinds"), (without, "no errors"), (elsewhere, "magnetometers")):
        found = compared(api, first, other)
        assert (found["word"], found["parameter"], found["differences"]) == ("cannot_tell", None, [])
        assert why in found["text"]


def test_who_may_ask_and_for_what(service, api, kept, base):
    first, second = kept(base, base)
    with service.client(service.key("ingest")) as sender:
        assert sender.get(f"/parameter-sets/{first}/comparison", params={"other": second}).status_code == 403
    with service.client(service.key("read", satellites=["another"])) as bound:
        assert bound.get(f"/parameter-sets/{first}/comparison", params={"other": second}).status_code == 404
    assert api.get(f"/parameter-sets/{first}/comparison").status_code == 422
    assert api.get(f"/parameter-sets/{first}/comparison", params={"other": "0" * 32}).status_code == 404

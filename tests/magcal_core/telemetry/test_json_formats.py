"""JSON in both forms: what a strict reader refuses, by place."""

import contextlib
import json

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from magcal_core.errors import InputError, TelemetryFormatError, TelemetryValueError, TimeError
from magcal_core.telemetry import read_samples

ROW = {"time": "2022-02-19T22:37:44Z", "bx": 30000.0, "by": 1.0, "bz": 2}


def ndjson(*rows: str) -> bytes:
    good = [json.dumps(ROW | {"time": f"2022-02-19T22:{m:02d}:44Z"}) for m in range(30)]
    return "\n".join([*good, *rows]).encode()


def columns(**changed: object) -> bytes:
    n = 30
    base: dict[str, object] = {
        "time": [1_600_000_000 + i for i in range(n)],
        "bx": [3e4] * n,
        "by": [1] * n,
        "bz": [2] * n,
    }
    return json.dumps(base | changed).encode()


@pytest.mark.parametrize(
    ("row", "where", "why"),
    [
        ('{"time": "2022-02-19T22:37:45Z", "bx": "30000", "by": 1, "bz": 2}', "line 31, column bx", "text"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": true, "by": 1, "bz": 2}', "line 31, column bx", "true or false"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": [1], "by": 1, "bz": 2}', "line 31, column bx", "an array"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": NaN, "by": 1, "bz": 2}', "line 31, column bx", "no such number"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": -Infinity, "by": 1, "bz": 2}', "line 31, column bx", "no such number"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": 1e999, "by": 1, "bz": 2}', "line 31, column bx", "too large"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": 1, "bx": 1, "by": 1, "bz": 2}', "line 31", "more than once"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": 1, "by": 1, "bz": 2"}', "line 31", "not JSON"),
        ('{"time": "2022-02-19T22:37:45Z", "bx": 1, "by": 1, "bz": 2} x', "line 31", "not JSON"),
        ("[1, 2, 3]", "line 31", "not a JSON object"),
        (
            '{"time": "2022-02-19T22:37:45Z", "bx": ' + "9" * 4000 + ', "by": 1, "bz": 2}',
            "line 31, column bx",
            "too large",
        ),
        ('{"time": ' + "[" * 1500 + "]" * 1500 + ', "bx": 1, "by": 1, "bz": 2}', "line 31", "nested"),
    ],
)
def test_a_bad_ndjson_row_is_named(row: str, where: str, why: str) -> None:
    with pytest.raises(InputError) as caught:
        read_samples(ndjson(row), format="ndjson")
    assert caught.value.faults[0].where == where
    assert why in caught.value.faults[0].why


def test_a_number_among_iso_times_is_a_fault() -> None:
    with pytest.raises(TimeError, match="a number in a column of ISO 8601 times"):
        read_samples(ndjson('{"time": 1645310265, "bx": 1, "by": 1, "bz": 2}'), format="ndjson")


def test_null_and_absent_cells_are_empty_cells() -> None:
    body = ndjson('{"time": "2022-02-19T23:00:00Z", "bx": null, "by": 1, "bz": 2, "temp": 3}')
    samples = read_samples(body, format="ndjson")
    assert samples.is_used.tolist() == [True] * 30 + [False]
    assert list(samples.housekeeping) == ["temp"]


def test_nested_housekeeping_is_ignored() -> None:
    body = ndjson('{"time": "2022-02-19T23:00:00Z", "bx": 30000, "by": 1, "bz": 2, "raw": {"a": [1]}}')
    assert read_samples(body, format="ndjson").housekeeping == {}


@pytest.mark.parametrize(
    ("body", "error", "match"),
    [
        (columns(bx=[1.0] * 29), TelemetryFormatError, "column bx: 29 cells, column time has 30"),
        (columns(bx=5), TelemetryFormatError, "column bx: not an array"),
        (columns(bx=[1.0] * 29 + ["x"]), TelemetryValueError, "row 30, column bx: text"),
        (columns(bx=[1.0] * 29 + [[1]]), TelemetryValueError, "row 30, column bx: an array"),
        (columns(bx=[1.0] * 29 + [float("nan")]), TelemetryValueError, "row 30, column bx: JSON has no such number"),
        (columns(time=[1_600_000_000] * 29 + ["x"]), TimeError, "row 30, column time: text"),
        (columns().replace(b'"by"', b'"bx"'), TelemetryFormatError, "more than once"),
        (b"[" * 100_000, TelemetryFormatError, "nested deeper"),
        (b'{"time":' + b"[" * 100_000, TelemetryFormatError, "nested deeper"),
        (b'[{"time": 1}]', TelemetryFormatError, "column bx: missing"),
        (b"[]", TelemetryFormatError, "a list without rows"),
        (b"5", TelemetryFormatError, "no object of arrays"),
        (columns()[:-5], TelemetryFormatError, "not JSON"),
        (columns(**{f"c{i}": [1] * 30 for i in range(600)}), TelemetryFormatError, "604 columns; the limit is 512"),
        (columns().replace(b"30000.0", b"9" * 5000), TelemetryFormatError, "limit"),
    ],
)
def test_bad_json_columns_are_named(body: bytes, error: type[InputError], match: str) -> None:
    with pytest.raises(error, match=match):
        read_samples(body, format="json")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.sampled_from(["json", "ndjson"]), st.dictionaries(st.sampled_from(["time", "bx", "by", "bz", "x"]), json_values)
)
@example("json", {"x": [[None, 1]]})  # a column that pyarrow reads into lists that do not hold together
def test_no_json_whatever_escapes_as_another_error(kind: str, value: dict[str, object]) -> None:
    with contextlib.suppress(InputError):
        read_samples(json.dumps(value).encode(), format=kind)


@given(st.sampled_from(["json", "ndjson", "parquet"]), st.binary(max_size=200))
def test_no_bytes_whatever_escape_as_another_error(kind: str, noise: bytes) -> None:
    for body in (noise, b"PAR1" + noise + b"PAR1", b'{"time":[' + noise):
        with contextlib.suppress(InputError):
            read_samples(body, format=kind)

"""HAPI servers (VirES among them): ``info`` says what a dataset holds, ``data`` gives it in CSV without a header."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from app.connectors.errors import SourceContentError, require_no_page
from app.connectors.http import SourceClient
from app.connectors.telemetry.contract import TIME, Page, PullOptionError, Wanted, instant, iso

SPAN: Final = timedelta(hours=6)
OK: Final = frozenset({1200, 1201})
"""HAPI's own status: all is well; all is well and there are no data."""


@dataclass(frozen=True, slots=True)
class Dataset:
    """What ``info`` says: the columns that ``data`` gives, a vector as ``name[0]``, ``name[1]``, ..., and the span."""

    columns: list[str]
    fills: dict[str, float]
    stop: datetime | None
    start: datetime | None


class Hapi:
    """Asks span by span (HAPI: time.min <= t < time.max), as far as the dataset reaches."""

    def pages(self, wanted: Wanted, mark: str | None, now: datetime) -> Iterator[Page]:
        """Yield a page a span."""
        if wanted.dataset is None:
            raise PullOptionError("hapi wants --dataset")
        client = SourceClient(wanted.base_url, {"authorization": f"Bearer {wanted.token}"} if wanted.token else {})
        base = wanted.base_url.rstrip("/")
        parameters = ",".join(dict.fromkeys(name.partition("[")[0] for name in wanted.names))
        try:
            dataset = _dataset(client.get(f"{base}/info", {"id": wanted.dataset, "parameters": parameters}), wanted)
            begin = instant(mark) if mark is not None else wanted.since or dataset.start
            if begin is None:
                raise PullOptionError("the first pull wants --since")
            last, reached = min(dataset.stop or now, now), begin
            begin = min(begin, wanted.again_from or begin)
            while begin < last:
                end = min(begin + SPAN, last)
                asked = {"id": wanted.dataset, "parameters": parameters, "time.min": iso(begin), "time.max": iso(end)}
                body = client.get(f"{base}/data", asked | {"format": "csv"})
                yield Page(_rows(require_no_page(body), dataset, wanted), iso(max(end, reached)))
                begin = end
        finally:
            client.close()


def _dataset(body: bytes, wanted: Wanted) -> Dataset:
    try:
        found = json.loads(require_no_page(body))
        if found["status"]["code"] not in OK:
            raise SourceContentError(f"the server says {found['status'].get('message', found['status']['code'])}")
        columns: list[str] = []
        fills: dict[str, float] = {}
        for parameter in found["parameters"]:
            size = math.prod(parameter.get("size", [1]))
            own = [parameter["name"]] if "size" not in parameter else [f"{parameter['name']}[{n}]" for n in range(size)]
            columns += own
            if _is_number(parameter.get("fill")):
                fills |= dict.fromkeys(own, float(parameter["fill"]))
    except (ValueError, TypeError, KeyError):
        raise SourceContentError("the answer is not HAPI's info") from None
    missing = [name for name in wanted.names if name not in columns]
    if missing:
        raise SourceContentError(f"the dataset has no {', '.join(missing)}; it has {', '.join(columns)}")
    times = [instant(found[name]) if isinstance(found.get(name), str) else None for name in ("stopDate", "startDate")]
    return Dataset(columns, fills, *times)


def _is_number(text: object) -> bool:
    try:
        return math.isfinite(float(str(text)))
    except ValueError:
        return False


def _rows(body: bytes, dataset: Dataset, wanted: Wanted) -> list[dict[str, str]]:
    """Return the rows of a CSV; the first column is the time, and a fill value is no value."""
    found: list[dict[str, str]] = []
    # A header behind # is JSON: read as CSV, its quotes would swallow line ends.
    lines = [line for line in body.decode("utf-8", "replace").splitlines() if line.strip() and not line.startswith("#")]
    for cells in csv.reader(lines):
        if len(cells) != len(dataset.columns):
            raise SourceContentError(f"a row has {len(cells)} columns, and info says {len(dataset.columns)}")
        row = dict(zip(dataset.columns, (one.strip() for one in cells), strict=True))
        values = {name: _unfilled(row[name], dataset.fills.get(name)) for name in wanted.names}
        if any(values.values()):
            found.append({TIME: cells[0].strip(), **values})
    return found


def _unfilled(text: str, fill: float | None) -> str:
    return "" if not _is_number(text) or float(text) == fill else text

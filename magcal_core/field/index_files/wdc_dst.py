"""Dst as the World Data Center in Kyoto gives it: a record of 120 columns a day [DST]_."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Final

import numpy as np

from magcal_core.field.index import HOUR_NS, Index
from magcal_core.field.index_files.rows import Rows

MARK: Final = "DST"
_MISSING: Final = 9999
_LENGTH: Final = 116
"""Columns that a record has at least: the daily mean, 117 to 120, may be missing."""
_WHOLE: Final = re.compile(r" *[+-]?\d+", re.ASCII)
_HOURS_NS: Final = np.arange(24) * HOUR_NS
_FINAL: Final = 2
"""Version of records that do not name one."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def is_record(line: str) -> bool:
    """Return whether ``line`` is meant as a record of Dst; anything else between them is left out."""
    return line.startswith(MARK) and (line[7:8] == "*" or line[3:4].isdigit())


def read(text: str, sha256: str) -> Index:
    """Return the index of a file of records.

    Raises
    ------
    IndexFormatError
        A record is short or has a letter where a number stands, there is no such day, a value is beyond +-2000 nT, or
        two records of one version differ.
    """
    rows = Rows(HOUR_NS)
    for line, record in enumerate(text.splitlines(), 1):
        if is_record(record):
            _add(rows, line, record)
    return rows.index("Dst", "wdc-dst", sha256)


def _add(rows: Rows, line: int, record: str) -> None:
    if len(record) < _LENGTH:
        rows.refuse(line, f"the record has {len(record)} columns; want 120, or 116 without the daily mean")
        return
    day = _day(rows, line, record)
    version = record[13:14].strip()
    if version and not (version.isascii() and version.isdigit()):
        rows.refuse(line, "columns 14: want the version, a digit or a blank", version)
        return
    base = record[16:20]
    if base.strip() and not _WHOLE.fullmatch(base):
        rows.refuse(line, "columns 17-20: want the base, hundreds of nT", base)
        return
    if day is None:
        return
    base_nt = 100.0 * int(base) if base.strip() else 0.0
    start_ns = (day - _EPOCH).days * 24 * HOUR_NS
    texts = [record[20 + 4 * hour : 24 + 4 * hour] for hour in range(24)]
    wrong = next((hour for hour, text in enumerate(texts) if not _WHOLE.fullmatch(text)), None)
    if wrong is not None:
        rows.refuse(line, f"columns {21 + 4 * wrong}-{24 + 4 * wrong}: want a whole number", texts[wrong])
        return
    values = [np.nan if (value := int(text)) == _MISSING else base_nt + value for text in texts]
    rows.add_all([line] * 24, start_ns + _HOURS_NS, [np.array(values)])
    rows.rank += [int(version or _FINAL)] * 24


def _day(rows: Rows, line: int, record: str) -> datetime | None:
    """Return the record's day, None where it has none: that is noted."""
    century, year, month, day = record[14:16], record[3:5], record[5:7], record[8:10]
    parts = ["19" if not century.strip() else century, year, month, day]
    if not all(_WHOLE.fullmatch(part) and int(part) >= 0 for part in parts):
        rows.refuse(line, "columns 4-10 and 15-16: want year, month, day and century", record[3:16])
        return None
    numbers = [int(part) for part in parts]
    try:
        return datetime(100 * numbers[0] + numbers[1], numbers[2], numbers[3], tzinfo=UTC)
    except ValueError:
        rows.refuse(line, "there is no such day", record[3:16])
        return None

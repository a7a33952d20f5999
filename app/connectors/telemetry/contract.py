"""What an archive of telemetry offers: its rows behind a mark, page by page, each with the mark behind it."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from typing import Final, Protocol

from magcal_core.errors import InputError

TIME: Final = "time"
LOOK_BACK: Final = timedelta(hours=72)
"""How late a row may come where nobody says otherwise."""


class PullOptionError(InputError):
    """A pull lacks something that its archive wants to be told."""

    code = "pull_option"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is pulled: from which address, and which names of the archive become which columns.

    ``columns`` maps a column of the telemetry table to a name of the archive; ``since`` is where a first pull begins.
    ``dataset`` is the archive's own word for what is asked: Yamcs' instance, HAPI's dataset, SatNOGS' NORAD id.
    ``by_history``: Yamcs' history of each parameter, page by page, instead of its export of a table. ``settle``: what
    is younger may still be on its way, and is left for a later pull. ``look_back``: so far back it is looked for what
    comes late; ``again_from``: where that begins in this pull, None where it does not look back.
    """

    base_url: str
    columns: Mapping[str, str]
    dataset: str | None = None
    since: datetime | None = None
    token: str | None = field(default=None, repr=False)
    by_history: bool = False
    settle: timedelta = timedelta()
    look_back: timedelta = LOOK_BACK
    again_from: datetime | None = None

    @property
    def names(self) -> list[str]:
        """The archive's names, but for that of the time."""
        return list(dict.fromkeys(name for column, name in self.columns.items() if column != TIME))


@dataclass(frozen=True, slots=True)
class Page:
    """Rows of an archive, each a mapping of its names, `TIME` among them; and the mark once they are kept."""

    rows: Sequence[Mapping[str, str]]
    mark: str


class Archive(Protocol):
    """One kind of archive."""

    def pages(self, wanted: Wanted, mark: str | None, now: datetime) -> Iterator[Page]:
        """Yield what is behind ``mark`` (None: from ``wanted.since``) and not younger than ``now``.

        Anew from ``wanted.again_from`` on, where that is set. In an order in which a kill loses nothing; the marks of
        pages do not go back behind ``mark``.
        """
        ...


def table_of(rows: Sequence[Mapping[str, str]], wanted: Wanted, sensor: Mapping[str, str] | None) -> bytes:
    """Return rows as CSV under the names that the magnetometer's own map of columns expects."""
    own = sensor or {}
    columns = {column: name for column, name in wanted.columns.items() if column != TIME}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([own.get(TIME, TIME), *(own.get(column, column) for column in columns)])
    for row in rows:
        writer.writerow([row[TIME], *(row.get(name, "") for name in columns.values())])
    return out.getvalue().encode()


_DAY_OF_YEAR: Final = re.compile(r"(\d{4})-(\d{3})(?!\d)(.*)")
_DATE_ALONE: Final = re.compile(r"(\d{4}-\d{2}-\d{2})Z?")


def instant(text: str) -> datetime:
    """Return a time of an archive; one without a zone is UTC, as theirs all are. A day may be the year's."""
    if found := _DAY_OF_YEAR.fullmatch(text):
        year, number, rest = found.groups()
        text = f"{date(int(year), 1, 1) + timedelta(days=int(number) - 1)}{rest}"
    if found := _DATE_ALONE.fullmatch(text):
        text = found[1]
    time = datetime.fromisoformat(text)
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def iso(time: datetime) -> str:
    """Return a time as archives take it, with ``Z``, to the millisecond where that says it all."""
    plain = time.astimezone(UTC).replace(tzinfo=None)
    return plain.isoformat(timespec="microseconds" if plain.microsecond % 1000 else "milliseconds") + "Z"

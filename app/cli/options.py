"""What the commands of the core share: how files and numbers are given, and progress for what takes its time."""

from __future__ import annotations

import gc
import json
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import click

from magcal_core.errors import InputError, OptionError
from magcal_core.field.choices import EXTERNAL_KINDS, INDEX_GAPS

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from click.shell_completion import CompletionItem
    from rich.progress import Progress, TaskID

    from magcal_core.field.index import Index
    from magcal_core.field.sources import FieldSources
    from magcal_core.orbit import Orbit

INPUT_FILE: Final = click.Path(exists=True, dir_okay=False, path_type=Path)
OUTPUT_FILE: Final = click.Path(dir_okay=False, writable=True, path_type=Path)
SHOW_PROGRESS_AFTER_S: Final = 1.0
"""Work that ends sooner shows no progress bar."""

_COLLECT_AFTER: Final = (100_000, 50, 50)

F = TypeVar("F", bound=Callable[..., object])


class Numbers(click.ParamType[tuple[float, ...]]):
    """A fixed count of numbers, commas or blanks between them."""

    name = "NUMBERS"

    def __init__(self, *counts: int) -> None:
        self.counts = counts
        self.name = "|".join(",".join("XYZUVW"[:count]) for count in counts)

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """Return the numbers of ``value``."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).replace(",", " ").split())
        except ValueError:
            numbers = ()
        if len(numbers) not in self.counts:
            wanted = " or ".join(str(count) for count in self.counts)
            self.fail(f"{value!r}: want {wanted} numbers with commas between them", param, ctx)
        return numbers


class ColumnMap(click.ParamType[Mapping[str, str]]):
    """A map of column names: JSON, or a file that holds it."""

    name = "JSON|FILE"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Mapping[str, str]:
        """Return the map of ``value``."""
        if isinstance(value, Mapping):
            return value
        text = str(value)
        if not text.lstrip().startswith("{"):
            path = Path(text)
            if not path.is_file():
                self.fail(f"{text!r} is neither JSON nor a file", param, ctx)
            text = path.read_text(encoding="utf-8")
        try:
            columns = json.loads(text)
        except ValueError as error:
            self.fail(f"not JSON: {error}", param, ctx)
        if not isinstance(columns, dict) or not all(isinstance(own, str) for own in columns.values()):
            self.fail('want {"time": "ts", "bx": "mag_0", ...}', param, ctx)
        return columns


class Windows(click.ParamType[float | str]):
    """Hours of a window, or ``auto``."""

    name = "HOURS|auto"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Return the hours of ``value``, or ``auto``."""
        if value == "auto":
            return "auto"
        try:
            return float(str(value))
        except ValueError:
            self.fail(f"{value!r}: want hours, or auto", param, ctx)


class Names(click.ParamType[str]):
    """One of the names of a registry, which is loaded only when a name or the help is asked for."""

    name = "choice"

    def __init__(self, load: Callable[[], Collection[str]]) -> None:
        self._load = load

    def _choice(self) -> click.Choice[str]:
        return click.Choice(list(self._load()))

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """Return the names as the help shows them."""
        return self._choice().get_metavar(param, ctx)

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the name, which must be one of the registry."""
        return self._choice().convert(str(value), param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the names that begin so."""
        return self._choice().shell_complete(ctx, param, incomplete)


class FieldModels(click.ParamType[str]):
    """The name of a field model; its parts are looked at where the model is made."""

    name = "MODEL"

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """Return the parts of a name as the help shows them."""
        from magcal_core.field.models import MAIN_FIELDS

        return f"{'|'.join(MAIN_FIELDS)}|file[+file][{'|'.join(f'+{kind}' for kind in EXTERNAL_KINDS)}]"


class TableFile(click.Path):
    """A file that a table is written to; its ending is its format, and an ending of compression may follow."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, writable=True, path_type=Path)

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """Return the endings as the help shows them."""
        from magcal_core.telemetry.formats import SUFFIXES, WRITERS

        return f"FILE{'|'.join(suffix for suffix, form in SUFFIXES.items() if form in WRITERS)}"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path; its ending must be that of a format that is written."""
        from magcal_core.telemetry.formats import WRITERS, format_of_name, suffixes_of

        path = Path(super().convert(value, param, ctx))  # type: ignore[arg-type]
        if format_of_name(path) not in WRITERS:
            self.fail(f"{path}: the ending is that of no format; use {suffixes_of(WRITERS)}", param, ctx)
        return path


def write_table(table: pa.Table, path: Path) -> None:
    """Write a table in the format of the path's ending."""
    from magcal_core.telemetry.formats import WRITERS, format_of_name

    path.write_bytes(WRITERS[str(format_of_name(path))](table))


class VectorCommand(click.Command):
    """A command whose vector options also take three separate numbers: ``--bias 1 2 3`` beside ``--bias 1,2,3``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Join three numbers after a vector option, then parse."""
        names = {
            name
            for param in self.params
            if isinstance(param.type, Numbers) and 3 in param.type.counts
            for name in param.opts
        }
        joined: list[str] = []
        rest = list(args)
        while rest:
            joined.append(rest.pop(0))
            if joined[-1] in names and len(rest) >= 3 and all(_is_number(text) for text in rest[:3]):
                joined.append(",".join(rest[:3]))
                del rest[:3]
        return super().parse_args(ctx, joined)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def added(function: F, options: Sequence[Callable[[F], F]]) -> F:
    """Return ``function`` with ``options`` added, in the order in which `--help` lists them."""
    for option in reversed(options):
        function = option(function)
    return function


def field_options(function: F) -> F:
    """Add the options of what a field model is made from beside its name."""
    return added(function, [
        click.option("--index", type=INPUT_FILE, multiple=True,
                     help="Index of the external field (RC, Dst, Kp), any number; of one kind the later one holds."),
        click.option("--field-file", type=INPUT_FILE, help="Coefficients, .shc or .COF, for a field with `file`."),
        click.option("--index-gap", type=click.Choice(INDEX_GAPS),
                     help="Where the index has no value: refuse, or its mean.  [default: refuse]"),
        click.option("--quiet-only", is_flag=True, default=None, help="Only samples of quiet hours; needs Kp."),
    ])  # fmt: skip


def collect_rarely() -> None:
    """Look for garbage after ten thousands of new objects, not hundreds.

    A command that computes once makes most of its objects as modules are loaded, and keeps them until it ends.
    """
    gc.set_threshold(*_COLLECT_AFTER)


def usage_error(error: OptionError) -> click.UsageError:
    """Return the wrong use of a command that an option's fault is."""
    return click.UsageError("\n".join(str(fault) for fault in error.faults) or error.message)


def orbits_of_file(path: Path) -> list[Orbit]:
    """Return the orbits in a file: TLEs, OMMs, an OEM or state vectors; the content tells which.

    Raises
    ------
    InputError
        The file holds no sound orbit; its faults say where.
    """
    from magcal_core.orbit.sources import parse_orbits

    return parse_orbits(path.read_bytes())


def sources_of(index: Sequence[Path], field_file: Path | None) -> FieldSources:
    """Return what the files of ``--index`` and ``--field-file`` hold; a fault's message says in which of them it is.

    Raises
    ------
    IndexFormatError, FieldFileError
        A file is none that magcal reads.
    """
    from magcal_core.field.sources import FieldSources

    indices: list[Index] = []
    for path in index:
        try:
            indices += FieldSources.of(path).indices
        except InputError as error:
            error.message = f"{path}: {error.message}"
            raise
    return FieldSources.of(indices, field_file)


def nearest(orbits: Sequence[Orbit], t_utc: np.datetime64) -> Orbit:
    """Return the orbit whose epoch is nearest to ``t_utc``."""
    return min(orbits, key=lambda orbit: abs(orbit.epoch_utc - t_utc))


class LateProgress:
    """A progress bar on stderr that appears on a terminal only, and only for work that takes longer than a second."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._since = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> LateProgress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, fraction: float) -> None:
        """Show that ``fraction``, 0 to 1, of the work is done."""
        if not sys.stderr.isatty() or time.monotonic() - self._since < SHOW_PROGRESS_AFTER_S:
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import Progress

            self._bar = Progress(console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task(self._what, total=1.0)
            self._bar.start()
        if self._task is not None:
            self._bar.update(self._task, completed=fraction)

"""Write the page of all names from their registries: `python docs/write_names.py`; a test compares it."""

from __future__ import annotations

import inspect
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from app.aboard.reading import READERS as READ_BACK
from app.jobs.kinds.registry import JOB_KINDS
from app.parameter_sets.export_formats import EXPORTERS
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.field.choices import EXTERNAL_KINDS
from magcal_core.field.models import FIELD_MODELS, MAIN_FIELDS
from magcal_core.sensor.conventions import CONVENTIONS
from magcal_core.telemetry.formats import FORMATS

PAGE: Final = Path(__file__).resolve().parent / "names.md"
HEAD: Final = """# Names

Every name that an option or a request takes, as the registries have them: `python docs/write_names.py` writes
this page, and a test compares it. What each of them does is on the page that is linked.
"""


def page() -> str:
    """Return the page."""
    return "\n".join([HEAD, *_methods(), *_fields(), *_tables(), *_exports(), *_jobs(), *_conventions()])


def _methods() -> Iterable[str]:
    rows = [
        (_code(name), _first_line(type(one)), "the field" if one.is_vector else "its magnitude")
        for name, one in ESTIMATORS.items()
    ]
    return _section("Calibration methods", "calibration.md", "`--method`", ("method", "what it is", "compares"), rows)


def _fields() -> Iterable[str]:
    rows = [(_code(name), "yes" if one.is_series else "no") for name, one in MAIN_FIELDS.items()]
    main = _section("Field models", "field.md", "`--field`", ("main field", "may be cut, frozen and added to"), rows)
    parts = ", ".join(_code(f"+{kind}") for kind in EXTERNAL_KINDS)
    whole = textwrap.wrap(f"{', '.join(map(_code, FIELD_MODELS))}.", 110, break_on_hyphens=False)
    return [*main, f"The external field is added by {parts}. Whole names are, among others:", *whole, ""]


def _tables() -> Iterable[str]:
    rows = [
        (
            _code(name),
            "yes" if one.is_read else "no",
            "yes" if one.is_written else "no",
            " ".join(map(_code, one.suffixes_of(name))),
            _code(one.media_types_of(name)[0]),
        )
        for name, one in FORMATS.items()
    ]
    head = ("format", "read as telemetry", "written", "endings", "content type")
    return _section("Tables", "telemetry.md", "`--format`, `format`", head, rows)


def _exports() -> Iterable[str]:
    rows = [
        (_code(name), _code(one.media_type), one.convention or "any", "yes" if name in READ_BACK else "no")
        for name, one in EXPORTERS.items()
    ]
    head = ("format", "content type", "convention", "read back")
    return _section("Exports of parameter sets", "how-to/what-flies.md", "`format`", head, rows)


def _jobs() -> Iterable[str]:
    rows = [(_code(name), _first_line(kind.body)) for name, kind in JOB_KINDS.items()]
    return _section("Kinds of job", "service.md", "`kind`", ("kind", "what it does"), rows)


def _conventions() -> Iterable[str]:
    rows = [(_code(name),) for name in CONVENTIONS]
    return _section("Conventions of parameters", "calibration.md", "`--to`, `convention`", ("convention",), rows)


def _section(title: str, where: str, option: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterable[str]:
    yield from (f"## {title}", "", f"{option}; see [{where}]({where}).", "")
    for row in (head, ["---"] * len(head), *rows):
        yield f"| {' | '.join(row)} |"
    yield ""


def _code(name: str) -> str:
    return f"`{name}`"


def _first_line(kind: type) -> str:
    """Return the first line of a docstring, without the equation that may follow it."""
    text = (inspect.getdoc(kind) or "").split("\n")[0]
    return text.rstrip(".").replace("|", "\\|")


if __name__ == "__main__":
    if sys.argv[1:] == ["--print"]:
        sys.stdout.write(page())
    else:
        PAGE.write_text(page(), encoding="utf-8")

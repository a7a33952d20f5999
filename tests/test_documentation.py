"""The documentation names everything that a user can meet: one setting, code, method or format too many fails."""

import importlib
import importlib.util
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import app
from app.attention.causes.registry import CAUSES
from app.cli.main import COMMANDS
from app.jobs.kinds.registry import JOB_KINDS
from app.main import create_app
from app.operations.magnetometer_metrics import READINGS
from app.parameter_sets.export_formats import EXPORTERS
from app.parameter_sets.reasons import REASONS
from app.settings import Settings
from benchmarks.magnetosphere import Spread
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import MagcalError
from magcal_core.field.models import FIELD_MODELS
from magcal_core.sensor.conventions import CONVENTIONS
from magcal_core.telemetry import READERS

DOCS = Path(__file__).resolve().parent.parent / "docs"
UNSEEN = {
    "error",
    "input",
    "internal",
    "lost_claim",
    "abandoned",
    "demo",
    "print",
    "source_answer",
    "source_unreachable",
    "source_content",
    "no_browser",
    "unreachable",
    "folder_taken",
    "job_failed",
    "foreign_answer",
    "stopped",
}
"""Bases, and codes that only a terminal or a log shows."""


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def error_kinds(kind: type[MagcalError]) -> Iterator[type[MagcalError]]:
    for one in kind.__subclasses__():
        yield one
        yield from error_kinds(one)


@pytest.mark.parametrize("name", sorted(Settings.model_fields))
def test_every_setting_is_documented(name: str) -> None:
    row = re.search(rf"^\| `MAGCAL_{name.upper()}` \| (.*?) \|", page("configuration.md"), re.MULTILINE)
    assert row is not None
    assert row[1] == Settings.model_fields[name].description


def test_no_setting_is_documented_that_is_not_there() -> None:
    named = re.findall(r"^\| `MAGCAL_(\w+)`", page("configuration.md"), re.MULTILINE)
    assert sorted(named) == sorted(name.upper() for name in Settings.model_fields)


def test_every_error_code_is_documented() -> None:
    for module in pkgutil.walk_packages(app.__path__, "app."):
        if ".cli." not in module.name:
            importlib.import_module(module.name)
    codes = {kind.code for kind in error_kinds(MagcalError)} - UNSEEN
    documented = set(re.findall(r"^\| `(\w+)` \|", page("errors.md"), re.MULTILINE))
    assert documented == codes


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_is_documented(name: str) -> None:
    assert f"magcal {name}" in page("command-line.md") + page("service.md") + page("report.md")


PLACES = [
    (ESTIMATORS, "calibration.md"),
    (CONVENTIONS, "calibration.md"),
    (FIELD_MODELS, "field.md"),
    (READERS, "telemetry.md"),
    (CAUSES, "how-to/three-in-the-morning.md"),
    (READINGS, "how-to/three-in-the-morning.md"),
    (REASONS, "how-to/when-it-says-refuse.md"),
    (JOB_KINDS, "service.md"),
    (EXPORTERS, "how-to/what-flies.md"),
]


@pytest.mark.parametrize(("names", "where"), PLACES)
def test_every_method_convention_model_and_format_is_documented(names: dict[str, object], where: str) -> None:
    text = page(where).lower()
    assert [name for name in names if name.lower() not in text] == []


def test_every_call_of_the_api_is_documented(tmp_path: Path) -> None:
    paths = create_app(Settings(data_dir=tmp_path), workers=0).openapi()["paths"]
    calls = {f"{method.upper()} {path.removeprefix('/api/v1')}" for path, calls in paths.items() for method in calls}
    assert calls == set(re.findall(r"^\| `((?:GET|POST|PUT|PATCH|DELETE) [^`]*)`", page("service.md"), re.MULTILINE))


PROMISES = {"L": 10, "F": 24, "B": 26, "A": 14, "W": 31}


def test_every_promise_of_the_reliability_page_has_a_figure_and_what_holds_it() -> None:
    rows = re.findall(r"^\| ([LFBAW]\d+) \|(.*)\|$", page("reliability.md"), re.MULTILINE)
    assert [name for name, _ in rows] == [f"{kind}{n + 1}" for kind, last in PROMISES.items() for n in range(last)]
    rooms = {path.stem for path in (DOCS.parent / "benchmarks").glob("*.py")}
    for name, row in rows:
        *cells, holders = row.split("|")
        assert all(cell.strip() for cell in cells), name
        named = re.findall(r"`([^`]+)`", holders)
        assert named, name
        missing = [one for one in named if one not in rooms and not (DOCS.parent / "tests" / one).exists()]
        assert missing == [], name


def test_lines_of_the_documentation_are_at_most_110_columns() -> None:
    wrap = script("wrap_lines")
    found = {path.name: lines for path in wrap.pages() if (lines := wrap.long_lines(path.read_text(encoding="utf-8")))}
    assert found == {}, "python docs/wrap_lines.py"


def test_wrapping_a_page_leaves_its_words_its_code_and_its_tables() -> None:
    words = "word " * 40
    free = f"- {words}`a code of {words}` {words}- 3 {words}\n\n{words}1. {words}\n"
    text = f"# {words}\n\n| {words} |\n\n    {words}\n\n{free}"
    wrap = script("wrap_lines")
    found = wrap.wrapped(text)
    assert found.split() == text.split()
    assert wrap.long_lines(text) and not [line for line in wrap.long_lines(found) if "`" not in line]
    assert wrap.wrapped(found) == found
    kept = [f"# {words}", f"| {words} |", f"    {words}"]
    assert [line for line in found.split("\n") if line in kept] == kept
    assert not re.search(r"^ *1\. ", found, re.MULTILINE)
    assert len(re.findall(r"^ *- ", found, re.MULTILINE)) == 1


def test_the_page_of_names_has_those_of_the_registries() -> None:
    assert page("names.md") == script("write_names").page(), "python docs/write_names.py"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_drawings_of_the_house_show_the_imports_that_the_code_has() -> None:
    for name, drawing in script("draw_house").drawings().items():
        assert (DOCS / "images" / name).read_text(encoding="utf-8") == drawing, f"python docs/draw_house.py: {name}"


def test_the_picture_of_the_external_field_shows_its_table_and_the_text_has_its_figures() -> None:
    picture = script("draw_external_field")
    for name, drawing in picture.drawings().items():
        assert (DOCS / "images" / name).read_text(encoding="utf-8") == drawing, f"draw_external_field.py: {name}"
    left = picture.read_table()
    assert {len(row) for row in left.values()} == {len(picture.GROUPS)}
    (size, ppm), (size_rc, ppm_rc) = left["igrf-14"][0], left["igrf-14+rc"][0]
    text = " ".join(page("field.md").split())
    falls = (
        f"common scale error of a session falls from {ppm:g} to {ppm_rc:g} ppm, and |B| from {size:.1f} to {size_rc:g}"
    )
    assert falls in text
    how_to = " ".join(page("how-to/indices.md").split())
    assert f"falls from {ppm:g} to {ppm_rc:g} ppm rms" in how_to


def test_a_table_that_is_measured_anew_is_read_back_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = script("draw_external_field")
    monkeypatch.setattr(picture, "PAGE", tmp_path / "field.md")
    picture.PAGE.write_text(f"before\n{picture.BEGIN}\nold\n{picture.END}\nafter\n", encoding="utf-8")
    spreads = {
        f"{name}": {group: Spread(12.34 + i, 1.0, 1234.4 + i) for i, group in enumerate(picture.GROUPS)}
        for name in (*picture.DRAWN, "igrf-14+rc, RC alone")
    }
    picture.write_table(spreads)
    written = picture.PAGE.read_text(encoding="utf-8")
    assert written.startswith("before\n")
    assert written.endswith("after\n")
    assert "old" not in written
    left = picture.read_table()
    assert list(left) == list(picture.DRAWN)
    assert left["igrf-14+rc"][:2] == [(12.3, 1234.0), (13.3, 1235.0)]
    assert picture.drawing(left).count(">1235<") == len(picture.DRAWN)

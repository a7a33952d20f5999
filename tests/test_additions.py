"""A new thing takes one file and one line in its registry: each kind of thing is added to a copy, and found everywhere.

The copy is of the packages as they are; a fresh process runs in it, so that nothing of this one's is changed.
"""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("app", "magcal_core", "magcal_client", "docs")


@dataclass(frozen=True)
class Addition:
    """One file, and one line of a registry with the import that it needs."""

    file: str
    source: str
    registry: str
    after: str
    line: str
    imported: str


ESTIMATOR = Addition(
    "magcal_core/calibration/estimators/toy.py",
    '''
"""A toy."""

from dataclasses import dataclass, replace

from magcal_core.calibration.estimators.scalar import ScalarFit


@dataclass(frozen=True, slots=True)
class ToyFit(ScalarFit):
    """What a toy minimises."""

    name: str = "toy-fit"

    def fit(self, observations, settings):
        """Return the estimate."""
        return replace(ScalarFit.fit(self, observations, settings), method=self.name)
''',
    "magcal_core/calibration/estimators/registry.py",
    '        "scalar": _scalar,\n',
    '        "toy-fit": ToyFit,\n',
    "from magcal_core.calibration.estimators.toy import ToyFit\n",
)
FIELD = Addition(
    "magcal_core/field/toy.py",
    '''
"""A toy."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class ToyField:
    """A field that is the same everywhere."""

    name: str = "toy-field"

    def field_itrf_nt(self, t_utc, r_itrf_km):
        """Return the field."""
        return np.tile([1.0, 2.0, 3.0], (len(t_utc), 1))
''',
    "magcal_core/field/models.py",
    '    "dipole": MainField(_dipole),\n',
    '    "toy-field": MainField(ToyField),\n',
    "from magcal_core.field.toy import ToyField\n",
)
READER = Addition(
    "magcal_core/telemetry/toy_read.py",
    '''
"""A toy: CSV behind a line that says so."""

from magcal_core.telemetry.csv_table import read_csv
from magcal_core.telemetry.table_format import TableCode


def _read(data, columns, *, max_rows, form):
    return read_csv(data.removeprefix(b"TOY\\n"), columns, max_rows=max_rows, form=form)


def load():
    """Return the code."""
    return TableCode(read=_read)
''',
    "magcal_core/telemetry/formats.py",
    '        signature=b"PAR1",\n    ),\n',
    '    "toy-read": TableFormat(toy_read.load, is_written=False, is_read_back=False, signature=b"TOY\\n"),\n',
    "from magcal_core.telemetry import toy_read\n",
)
WRITER = Addition(
    "magcal_core/telemetry/toy_written.py",
    '''
"""A toy: how many rows there are."""

from magcal_core.telemetry.table_format import TableCode


def load():
    """Return the code."""
    return TableCode(write=lambda table: b"%d rows" % table.num_rows)
''',
    "magcal_core/telemetry/formats.py",
    '        signature=b"PAR1",\n    ),\n',
    '    "toy-written": TableFormat(toy_written.load, is_read=False, is_read_back=False),\n',
    "from magcal_core.telemetry import toy_written\n",
)
EXPORT = Addition(
    "app/parameter_sets/toy_export.py",
    '''
"""A toy: the id alone."""


def write_toy(document):
    """Return the id."""
    return str(document["id"])
''',
    "app/parameter_sets/export_formats.py",
    '    "yaml": ExportFormat("application/yaml", _yaml),\n',
    '    "toy-export": ExportFormat("text/x-toy", write_toy),\n',
    "from app.parameter_sets.toy_export import write_toy\n",
)
JOB = Addition(
    "app/jobs/kinds/toy.py",
    '''
"""A toy."""

from typing import Literal

from app.jobs.kinds.contract import Admission, Outcome
from app.jobs.schemas import JobBody


class ToyBody(JobBody):
    """Do what a toy does."""

    kind: Literal["toy-job"]
    times: int = 1


class ToyKind:
    """Does nothing, so many times."""

    body = ToyBody
    function = "app.jobs.kinds.toy:work"
    warm = ""

    def admit(self, session, caller, body):
        """Return what is asked for."""
        return Admission({"times": body.times})

    def check(self, session, admission):
        """Nothing can be wrong."""

    def load(self, session, store, claim):
        """Return what there is to do."""
        return claim.request["times"]

    def keep(self, session, store, claim, found):
        """Return what was found."""
        return found.record


def work(work, report):
    """Do it."""
    return Outcome({"done": work})
''',
    "app/jobs/kinds/registry.py",
    '    "monitoring": MonitoringKind(),\n',
    '    "toy-job": ToyKind(),\n',
    "from app.jobs.kinds.toy import ToyKind\n",
)
ADDITIONS = {
    "toy-fit": ESTIMATOR,
    "toy-field": FIELD,
    "toy-read": READER,
    "toy-written": WRITER,
    "toy-export": EXPORT,
    "toy-job": JOB,
}

PROBE = """
import json, re, sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from pydantic import TypeAdapter

import magcal_core
from app.cli.main import magcal
from app.http.tables import TableFormat
from app.jobs.kinds.registry import JobRequest
from app.main import create_app
from app.parameter_sets.schemas import ExportQuery
from app.records.calibration_options import CalibrationOptionsBody
from app.settings import Settings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import OptionError
from magcal_core.options import CalibrationOptions
from magcal_core.telemetry import read_samples, write_samples

here, data = Path(sys.argv[1]), Path(sys.argv[2])
assert Path(magcal_core.__file__).is_relative_to(here)


def refused(call):
    try:
        call()
    except OptionError as error:
        return error.message
    raise AssertionError("not refused")


def help_of(*command):
    # Words are broken where a line ends: blanks say nothing.
    return re.sub(r"\\s+", "", CliRunner().invoke(magcal, [*command, "--help"]).output)


def names_page():
    spec = spec_from_file_location("write_names", here / "docs" / "write_names.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.page()


CalibrationOptions(method="toy-fit", field="toy-field")
toy = read_samples(b"TOY\\n" + (data / "nominal.csv").read_bytes())
settings = Settings(data_dir=here / "data")
application = create_app(settings, workers=0)
print(json.dumps({
    "allowed": {
        "toy-fit": refused(lambda: CalibrationOptions(method="none such")),
        "toy-field": refused(lambda: CalibrationOptions(field="none such")),
        "toy-read": refused(lambda: read_samples(b"x", format="none such")),
        "toy-written": refused(lambda: write_samples(toy, "none such")),
    },
    "schema": {
        "toy-fit": CalibrationOptionsBody.model_json_schema(),
        "toy-field": CalibrationOptionsBody.model_json_schema(),
        "toy-written": TypeAdapter(TableFormat).json_schema(),
        "toy-export": ExportQuery.model_json_schema(),
        "toy-job": TypeAdapter(JobRequest).json_schema(),
    },
    "help": {
        "toy-fit": help_of("calibrate"),
        "toy-field": help_of("calibrate") + help_of("simulate") + help_of("rom"),
        "toy-read": help_of("calibrate"),
        "toy-written": help_of("simulate") + help_of("trend"),
    },
    "openapi": application.openapi(),
    "page": names_page(),
    "used": {
        "method": ESTIMATORS[CalibrationOptions(method="toy-fit").method].name,
        "samples": len(toy),
        "field": magcal_core.field_model("toy-field").field_itrf_nt(toy.t_utc[:1], np.zeros((1, 3))).tolist(),
        "written": write_samples(toy, "toy-written").decode(),
        "job": TypeAdapter(JobRequest).validate_python({"kind": "toy-job", "times": 3}).model_dump(),
    },
}))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, object]]:
    """What a process says of a copy of the packages with every addition in it."""
    copy = tmp_path_factory.mktemp("copy")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.pyc", "images"))
    for one in ADDITIONS.values():
        (copy / one.file).write_text(one.source.lstrip(), encoding="utf-8")
        registry = copy / one.registry
        text = registry.read_text(encoding="utf-8")
        assert text.count(one.after) == 1
        head = "from __future__ import annotations\n"
        assert text.count(head) == 1
        text = text.replace(one.after, one.after + one.line).replace(head, head + one.imported)
        registry.write_text(text, encoding="utf-8")
    probe = copy / "probe.py"
    probe.write_text(PROBE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(probe), str(copy), str(ROOT / "tests" / "data" / "calibration")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        cwd=copy,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, dict[str, object]] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("name", ["toy-fit", "toy-field", "toy-read", "toy-written"])
def test_an_addition_is_among_the_values_that_an_option_may_have(answers, name):
    assert name in answers["allowed"][name]


@pytest.mark.parametrize("name", ["toy-fit", "toy-field", "toy-written", "toy-export", "toy-job"])
def test_an_addition_is_in_the_schema_of_a_request(answers, name):
    assert json.dumps(name) in json.dumps(answers["schema"][name])


@pytest.mark.parametrize("name", ["toy-fit", "toy-field", "toy-read", "toy-written"])
def test_an_addition_is_in_the_help_of_the_command_line(answers, name):
    assert name in answers["help"][name]


@pytest.mark.parametrize("name", ADDITIONS)
def test_an_addition_is_in_the_openapi_document_and_in_the_list_of_the_documentation(answers, name):
    assert name in json.dumps(answers["openapi"])
    assert f"`{name}`" in answers["page"]


def test_what_was_added_works(answers):
    assert answers["used"] == {
        "method": "toy-fit",
        "samples": answers["used"]["samples"],
        "field": [[1.0, 2.0, 3.0]],
        "written": f"{answers['used']['samples']} rows",
        "job": {"kind": "toy-job", "priority": 0, "times": 3},
    }
    assert answers["used"]["samples"] > 100


def test_a_format_that_is_only_read_is_not_offered_for_answers(answers):
    assert "toy-read" not in json.dumps(answers["schema"]["toy-written"])
    assert "toy-read" not in answers["allowed"]["toy-written"]
    assert "toy-written" not in answers["allowed"]["toy-read"]

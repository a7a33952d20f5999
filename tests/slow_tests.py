"""Which tests are too slow for `make test-quick`: noted in slow_tests.txt by this script, from a run of the tests.

    python -m pytest --junitxml=times.xml
    python tests/slow_tests.py times.xml

A test that is not noted, as a new one is, counts as quick.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path
from typing import Final

NOTED: Final = Path(__file__).with_name("slow_tests.txt")
ONE_S: Final = 0.25
"""The longest that a quick test takes, with the fixtures that it is the first to ask for."""
ALL_S: Final = 0.8
"""The longest that all cases of a quick test take together."""


def name_of(nodeid: str) -> str:
    """Return a test's name without its parameters: `tests.app.test_x::test_y`, classes joined by dots."""
    path, *inside = nodeid.split("[", maxsplit=1)[0].split("::")
    return "::".join([".".join([path.removesuffix(".py").replace("/", "."), *inside[:-1]]), inside[-1]])


def slow_in(report: Path) -> list[str]:
    """Return the names of the slow tests of a run, from its JUnit report."""
    seconds: dict[str, list[float]] = defaultdict(list)
    for case in ET.parse(report).iter("testcase"):  # noqa: S314 the report is this project's own
        seconds[f"{case.get('classname')}::{str(case.get('name')).split('[')[0]}"].append(float(case.get("time") or 0))
    return sorted(name for name, each in seconds.items() if max(each) > ONE_S or sum(each) > ALL_S)


if __name__ == "__main__":
    NOTED.write_text("\n".join(slow_in(Path(sys.argv[1]))) + "\n", encoding="utf-8")

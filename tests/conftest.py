"""What every test may ask for: the repository's folders and the real telemetry, where it is at hand."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The tests' own data."""
    return ROOT / "tests" / "data"


@pytest.fixture(scope="session")
def bro4_dir() -> Path:
    """BRO-4 telemetry: read where it lies, never copied, because it carries no licence."""
    folder = Path(os.environ.get("MAGCAL_BRO4_DIR", ROOT.parent / "shared" / "data" / "bro4"))
    if not (folder / "external.csv").exists():
        pytest.skip(f"BRO-4 telemetry is not at {folder}: it carries no licence, so it is not part of this project")
    return folder

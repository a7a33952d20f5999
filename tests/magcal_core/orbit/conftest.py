"""astropy and satkit as oracles, kept off the network."""

from collections.abc import Iterator
from pathlib import Path

import astropy_iers_data
import pytest
import satkit
import satkit_data
from astropy.utils import iers


@pytest.fixture(scope="session")
def offline_astropy() -> None:
    """Let astropy use the IERS table that is installed, never one from the network."""
    iers.conf.auto_download = False
    iers.conf.auto_max_age = None
    iers.earth_orientation_table.set(iers.IERS_A.open(iers.IERS_A_FILE))


@pytest.fixture(scope="module")
def offline_satkit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let satkit read the files that are installed, never the network."""
    folder = tmp_path_factory.mktemp("satkit")
    published = Path(satkit_data.__file__).parent / "data"
    for name in ("EGM96.gfc", "linux_p1550p2650.440", "tab5.2a.txt", "tab5.2b.txt", "tab5.2d.txt", "leap-seconds.list"):
        (folder / name).symlink_to(published / name)
    (folder / "finals2000A.all").symlink_to(astropy_iers_data.IERS_A_FILE)
    patch = pytest.MonkeyPatch()
    patch.setenv("SATKIT_OFFLINE", "1")
    patch.setenv("SATKIT_DATA", str(folder))
    satkit.utils.set_datadir(str(folder))
    yield
    patch.undo()

"""astropy as an oracle, kept off the network."""

import pytest
from astropy.utils import iers


@pytest.fixture(scope="session")
def offline_astropy() -> None:
    """Let astropy use the IERS table that is installed, never one from the network."""
    iers.conf.auto_download = False
    iers.conf.auto_max_age = None
    iers.earth_orientation_table.set(iers.IERS_A.open(iers.IERS_A_FILE))

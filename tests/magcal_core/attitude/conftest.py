from collections.abc import Callable

import pytest

from magcal_core.attitude.options import RomOptions
from magcal_core.attitude.rom import RomResult, simulate_rom
from magcal_core.sensor.model import SensorModel

FIGURE_1 = (110.0, -130.0, 170.0)


@pytest.fixture(scope="session")
def fly() -> Callable[..., RomResult]:
    """Simulate with the options of `RomOptions`, the defaults being the reference case of attitude control."""
    return lambda **spec: simulate_rom(RomOptions.from_dict(spec).scenario())


@pytest.fixture(scope="session")
def table_1() -> SensorModel:
    """DEKART, Table 1 (docs/references.md: DEKART)."""
    return SensorModel([2928.125, -1191.25, -1875.625], [1.032695, 1.006685, 1.032875], [-4.53, -1.067, 7.915])


@pytest.fixture(scope="session")
def table_2() -> SensorModel:
    """DEKART, Table 2 (docs/references.md: DEKART)."""
    return SensorModel([2807.5, -2056.25, -2070.625], [1.024175, 0.988788, 1.026907], [-4.22, -2.133, 8.504])

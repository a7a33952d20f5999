"""The external dipole, in a pass of its own over the samples."""

from __future__ import annotations

import math

from magcal_core.arrays import Floats, Nanoseconds
from magcal_core.numerics.kernel import kernel


@kernel(error_model="numpy", fastmath={"contract", "nsz"})
def add_external(  # noqa: PLR0917 (numba takes no keyword arguments)
    stamps_ns: Nanoseconds,
    r_km: Floats,
    knots_ns: Nanoseconds,
    dipole_nt: Floats,
    start_ns: int,
    step_ns: int,
    cells: Floats,
    mean: tuple[float, float],
    constants: tuple[float, float, float],
    field_nt: Floats,
) -> int:
    """Add the external field to ``field_nt``, shape (n, 3), nT, and return how many samples have no index.

    Parameters
    ----------
    knots_ns, dipole_nt : shape (k,), (k, 3)
        -(g11, h11, g10) of the main field, nT, linear between knots.
    start_ns, step_ns, cells : shape (m, 4)
        The index: in each cell of ``step_ns`` from ``start_ns`` on external part, its slope, induced part, its slope.
    mean : external and induced part where there is no index, nT; NaN where that is refused.
    constants : G, U, nT, and the reference radius a, km.

    Notes
    -----
    B = (G e - U) n + G i (a/r)^3 (n - 3 (n.u) u), n the unit vector along the dipole, u = r/|r|.
    """
    gain, uniform_nt, radius_km = constants
    interval, cell, last, unknown = 0, -1, len(knots_ns) - 2, 0
    low, high = 0, 0
    former, per_ns = -1, 0.0
    for k in range(len(stamps_ns)):
        stamp = stamps_ns[k]
        while interval > 0 and stamp < knots_ns[interval]:
            interval -= 1
        while interval < last and stamp >= knots_ns[interval + 1]:
            interval += 1
        if interval != former:
            former, per_ns = interval, 1.0 / float(knots_ns[interval + 1] - knots_ns[interval])
        part = float(stamp - knots_ns[interval]) * per_ns
        a, b = dipole_nt[interval], dipole_nt[interval + 1]
        nx, ny, nz = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * (b[2] - a[2])
        size = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
        nx, ny, nz = nx * size, ny * size, nz * size
        if not low <= stamp < high:
            cell = (stamp - start_ns) // step_ns
            low = start_ns + cell * step_ns
            high = low + step_ns
        external, induced = mean
        if 0 <= cell < len(cells) and not math.isnan(cells[cell, 0]):
            elapsed = float(stamp - low)
            external = cells[cell, 0] + elapsed * cells[cell, 1]
            induced = cells[cell, 2] + elapsed * cells[cell, 3]
        unknown += math.isnan(external)
        x, y, z = r_km[k, 0], r_km[k, 1], r_km[k, 2]
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        ratio = radius_km * inverse
        uniform = gain * external - uniform_nt
        dipole = gain * induced * ratio * ratio * ratio
        along = 3.0 * dipole * (nx * x + ny * y + nz * z) * (inverse * inverse)
        both = uniform + dipole
        field_nt[k, 0] += both * nx - along * x
        field_nt[k, 1] += both * ny - along * y
        field_nt[k, 2] += both * nz - along * z
    return unknown

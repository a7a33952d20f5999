"""The field in GCRF at the samples, from whichever column or position has it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.orbit.earth.frames import gcrf_to_itrf_matrix
from magcal_core.reference.referenced_samples import Referenced


def inertial_field_nt(referenced: Referenced, rows: NDArray[np.bool_]) -> Floats | None:
    """Return the field in GCRF at the samples ``rows``, shape (m, 3), nT; None where nothing says where they are."""
    samples = referenced.samples
    if samples.b_ref_gcrf_nt is not None:
        return samples.b_ref_gcrf_nt[rows]
    if samples.r_itrf_km is None:
        return None
    t_utc, r_km = samples.t_utc[rows], samples.r_itrf_km[rows]
    b_nt = referenced.field.field_itrf_nt(t_utc, r_km)
    return np.asarray(np.einsum("nji,nj->ni", gcrf_to_itrf_matrix(t_utc), b_nt))

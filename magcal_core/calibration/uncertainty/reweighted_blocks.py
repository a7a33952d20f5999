"""Where the estimate goes when blocks of the data weigh more or less: one Newton step, from sums that the fit has kept.

Notes
-----
With score s_k and normal matrix N_k of block k at the estimate, weights c_k move it by -(sum c_k N_k)^-1 sum c_k s_k:
no sample is looked at. It is exact where the residual is linear in the unknowns; elsewhere whoever takes the step
refits the farthest ones and compares.
"""

from __future__ import annotations

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit


def moves_of(near: Fit, counts: Floats, *, is_vector: bool) -> Floats:
    """Return how far the parameters of ``near``, without its clock, move where its blocks weigh ``counts``.

    Parameters
    ----------
    counts : shape (m, blocks)
        Weight of each block of `Fit.blocks`; all of them one moves nothing.

    Returns
    -------
    shape (m, p)
        NaN, all of it, where one row of ``counts`` leaves nothing that determines some unknown.

    Notes
    -----
    A vector fit's scores have the derivative of the model in them, a scalar one's that of the residual: hence the sign.
    """
    blocks, clock = near.blocks, near.clock.size
    q = blocks.scores.shape[1] - clock
    steps = steps_of(blocks.scores[:, :q], blocks.normals[:, :q, :q], counts)
    return np.asarray((-1.0 if is_vector else 1.0) * steps @ blocks.to_parameters[: -clock or None, :q].T)


def steps_of(scores: Floats, normals: Floats, counts: Floats) -> Floats:
    """Return the Gauss-Newton steps, shape (m, q), where blocks weigh ``counts``, shape (m, blocks).

    ``scores``, shape (blocks, q), and ``normals``, shape (blocks, q, q): with the derivative of the residual in them.
    NaN, all of them, where one row of ``counts`` leaves nothing that determines some unknown.
    """
    normals = np.tensordot(counts, normals, 1)
    scores = counts @ scores
    size = np.sqrt(np.maximum(np.diagonal(normals, axis1=1, axis2=2), 1e-300))
    try:
        steps = np.linalg.solve(normals / (size[:, :, None] * size[:, None, :]), (scores / size)[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        steps = np.full_like(scores, np.nan)
    return np.asarray(-steps / size)

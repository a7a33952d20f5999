"""What no residual of a session shows: errors locked to the orbit, and errors of the reference.

Notes
-----
The same that a calibration widens its errors by, for estimates that are none: several sessions together, one step from
parameters in force. Locked terms a stand beside the parameters d, of which something is known from elsewhere (other
sessions, a prior): with the covariance C of d under white noise, J'F the products of the session's own rows,

    error of d from the terms = C J'F E[a a'] F'J C,     E[a a'] over their posterior.

An error of the reference moves d by C J'c.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from magcal_core.arrays import Floats
from magcal_core.calibration.estimators.contract import Fit, FitStatus
from magcal_core.calibration.estimators.linear_rows import Rows, rows_of
from magcal_core.calibration.terms.evidence import Reduced, mixture_of
from magcal_core.calibration.terms.locked import locked_terms
from magcal_core.calibration.terms.locked_columns import LockedColumns
from magcal_core.calibration.terms.locked_rows import largest_terms, products_of, share_of
from magcal_core.calibration.uncertainty.consider_errors import ReferenceErrors, reference_shifts
from magcal_core.calibration.uncertainty.honest_covariance import covered_s, widened_covariance
from magcal_core.numerics.blocks import BlockScores
from magcal_core.numerics.linear_algebra import scaled_inverse
from magcal_core.observations import Observations, residuals_nt
from magcal_core.sensor.parameters import Parameters

SHARED_SIGN: Final = "external"
"""Begin of the names of errors that have the same sign in every session: what a field model lacks lasts."""


class Surrounded(Protocol):
    """A session that knows what its errors may be locked to, and what its reference may be off by."""

    def columns(self, observations: Observations, fit: Fit) -> LockedColumns | None:
        """Return the locked columns; None where nothing is known that a bias could be locked to, or none are asked."""
        ...

    def reference(self) -> ReferenceErrors | None:
        """Return the errors of the reference; None where it came with the telemetry."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class HiddenErrors:
    """What is hidden in one session, by its parameters in the order of their names, the clock left out.

    Attributes
    ----------
    locked : shape (p, p)
        Covariance of the parameters from locked errors.
    pushes : shape (m, p)
        J'c of each error of the reference: times C, what it does to the parameters.
    sources : tuple of str
    """

    locked: Floats
    pushes: Floats
    sources: tuple[str, ...]

    def shifts(self, covariance: Floats) -> Floats:
        """Return what each error of the reference does under the white-noise ``covariance`` C, shape (m, p)."""
        return np.asarray(self.pushes @ covariance)


def hidden_errors(
    o: Observations,
    at: Parameters,
    sigma_nt: float,
    covariance: Floats,
    session: Surrounded,
    *,
    is_vector: bool,
    is_minimum: bool,
) -> HiddenErrors:
    """Return what is hidden in the session of the observations ``o``, with their weights, at the parameters ``at``.

    Parameters
    ----------
    sigma_nt : float
        Deviation of the residual that the session is weighed with, nT.
    covariance : shape (p, p)
        C, of the parameters under white noise, with all that is known of them.
    is_minimum : bool
        Whether the parameters are an estimate, at which nothing pulls; else one step away from it.
    """
    fit = _as_fit(o, at, is_vector=is_vector)
    channels = 3 if is_vector else 1
    rows = rows_of(o, fit, sigmas_nt=[sigma_nt] * channels)
    back = np.asarray(np.linalg.inv(rows.unknowns.to_parameters(rows.matrix)), np.float64)
    columns, errors = session.columns(o, fit), session.reference()
    p = len(back)
    locked = np.zeros((p, p))
    if columns is not None:
        locked = _locked(rows, columns, back, covariance, is_minimum=is_minimum)
    if errors is None:
        return HiddenErrors(locked, np.zeros((0, p)), ())
    few, products = errors.products(o, fit, np.zeros(1, np.intp))
    every = rows.moments(np.zeros((len(o), 0)), np.zeros(1, np.intp)).blocks[0, :p, :p]
    # Few rows stand for all, each over a deviation of its own.
    size = float(np.mean(np.diag(every) / np.maximum(np.diag(products[0])[:p], 1e-300)))
    own = few.unknowns.to_parameters(few.matrix)
    pushes = size * products[0, p:, :p] @ np.linalg.inv(own)
    return HiddenErrors(locked, pushes, tuple(name for name, _ in errors.named))


def _locked(rows: Rows, columns: LockedColumns, back: Floats, covariance: Floats, *, is_minimum: bool) -> Floats:
    p, t = len(back), columns.columns.shape[1]
    to_parameters = np.eye(p + 3 * t + 1)
    to_parameters[:p, :p] = back
    total = to_parameters.T @ rows.moments(columns.columns, np.zeros(1, np.intp)).blocks[0] @ to_parameters
    total[:p, :p] = scaled_inverse(covariance)
    if is_minimum:
        total[:p, -1] = total[-1, :p] = 0.0
    reduced = Reduced.of(total, p)
    a = largest_terms(reduced)
    products = products_of(rows, columns.columns, back @ (reduced.offset - reduced.carry @ a), a)
    share = share_of(products[1:] / max(float(products[0]), 1e-300), rows.count)
    freedom = max(rows.freedom, 1)
    families = columns.locked_families
    mixture = mixture_of(reduced, families.of_terms, freedom, share, own_sizes=families.own_sizes)
    formal = float(mixture.weights @ mixture.noise) / share * reduced.inverse
    found = mixture.covariance(np.zeros(p)) - formal
    return 0.5 * (found + found.T)


def _as_fit(o: Observations, at: Parameters, *, is_vector: bool) -> Fit:
    """Return parameters that no fit has found in the form of one."""
    p = at.vector.size
    nothing = BlockScores(np.zeros((1, p)), np.zeros((1, p, p)), np.zeros(1, np.intp), np.eye(p))
    r = residuals_nt(o, at, is_vector)
    return Fit("", at, np.zeros((p, p)), r, o.weights, 1.0, 0.0, FitStatus.CONVERGED, 0, nothing)


def covariance_alone(fit: Fit, o: Observations, session: Surrounded | None) -> Floats:
    """Return the covariance of one session's ``fit``: honest, beside locked errors, with errors of the reference."""
    duration_s = covered_s(o.t_s)
    columns = None if session is None else session.columns(o, fit)
    if columns is None:
        found = widened_covariance(fit.blocks, fit.covariance, duration_s)
    else:
        found = locked_terms(o, fit, columns, duration_s, never=True).covariance
    if session is None:
        return found
    shifts = [one.shift for one in reference_shifts(session.reference(), o, fit)]
    return found + sum((np.outer(shift, shift) for shift in shifts), np.zeros_like(found))

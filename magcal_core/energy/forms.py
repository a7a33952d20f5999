"""The forms of the energy balance by name; what they compute with is loaded when one is computed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from magcal_core.constants import EARTH_ROTATION_RAD_S

if TYPE_CHECKING:
    from magcal_core.arrays import Floats
    from magcal_core.energy.terms import Series, Track


def _corrected(track: Track, terms: Series) -> Floats:
    return terms["kinetic"] + terms["rotation"] - terms["dissipation"] - terms["tidal_work"]


def _with_frame_rate(track: Track, terms: Series) -> Floats:
    return _corrected(track, terms) + terms["frame_rate"]


def _static(track: Track, terms: Series) -> Floats:
    from magcal_core.energy.terms import static_tide

    return terms["kinetic"] + terms["rotation"] - terms["dissipation"] - static_tide(terms)


def _uncorrected(track: Track, terms: Series) -> Floats:
    return terms["kinetic"] + terms["rotation"]


def _wrong_sign(track: Track, terms: Series) -> Floats:
    return terms["kinetic"] - terms["rotation"]


def _no_rotation(track: Track, terms: Series) -> Floats:
    return terms["kinetic"]


def _about(track: Track, terms: Series, axis: Floats) -> Floats:
    import numpy as np

    from magcal_core.energy.terms import M2_PER_KM2

    momentum = np.cross(track.r_km, track.v_km_s)
    return terms["kinetic"] - EARTH_ROTATION_RAD_S * np.asarray(np.vecdot(axis, momentum), np.float64) * M2_PER_KM2


def _about_itrf_z(track: Track, terms: Series) -> Floats:
    from magcal_core.orbit.propagators.forces import gcrf_to_itrf_matrices

    return _about(track, terms, gcrf_to_itrf_matrices(track.t_s, track.tables)[:, 2, :])


def _about_gcrf_z(track: Track, terms: Series) -> Floats:
    import numpy as np

    return _about(track, terms, np.broadcast_to([0.0, 0.0, 1.0], track.r_km.shape))


def _work_against_inertial_velocity(track: Track, terms: Series) -> Floats:
    from magcal_core.energy.terms import inertial_work_m2_s2

    return _with_frame_rate(track, terms) + terms["dissipation"] - inertial_work_m2_s2(track)


def _printed(track: Track, terms: Series) -> Floats:
    from magcal_core.energy.terms import printed_m2_s2

    return printed_m2_s2(track)


FORMS: Final[Mapping[str, Callable[[Track, Series], Floats]]] = MappingProxyType(
    {
        "corrected": _corrected,
        "frame-rate": _with_frame_rate,
        "printed": _printed,
        "static-tide": _static,
        "no-correction": _uncorrected,
        "rotation-wrong-sign": _wrong_sign,
        "no-rotation": _no_rotation,
        "rotation-about-itrf-z": _about_itrf_z,
        "rotation-about-gcrf-z": _about_gcrf_z,
        "dissipation-inertial": _work_against_inertial_velocity,
    }
)
"""Form -> H + U along the track, m2/s2: ``corrected`` is the balance; the others show what each error costs."""


def hamiltonian_m2_s2(track: Track, terms: Series, form: str = "corrected") -> Floats:
    """Return H along ``track`` in one of `FORMS`, shape (n,), m2/s2.

    Notes
    -----
    ``corrected``: H = v^2/2 - w.(r x v) - U - int a.(v - w x r) dt - E_tid with w along the pole (ENERGY). ``printed``:
    the paper's (9), which counts the rotation twice, with its signs of the dissipation and its (17), (18).
    """
    return FORMS[form](track, terms) - terms["potential"]

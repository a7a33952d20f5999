"""magcal's science: arrays in, arrays out; no web, no database, no clock, no environment.

The names below are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from magcal_core.calibration.refit.moments import FitMoments as FitMoments
    from magcal_core.calibration.refit.outcome import RefitOptions as RefitOptions
    from magcal_core.calibration.refit.refit import refit as refit
    from magcal_core.calibration.result import Calibration as Calibration
    from magcal_core.calibration.sessions.trend import Trend as Trend
    from magcal_core.calibration.sessions.trend import trend as trend
    from magcal_core.calibration.terms.bias_path import bias_path as bias_path
    from magcal_core.calibration.terms.bias_steps import bias_steps as bias_steps
    from magcal_core.field.coefficient_files import read_field_file as read_field_file
    from magcal_core.field.coefficients import CoefficientFile as CoefficientFile
    from magcal_core.field.dipole import DirectDipole as DirectDipole
    from magcal_core.field.igrf import Igrf as Igrf
    from magcal_core.field.index import Index as Index
    from magcal_core.field.index_files import read_index as read_index
    from magcal_core.field.models import field_model as field_model
    from magcal_core.orbit.ephemeris.oem import OemOrbit as OemOrbit
    from magcal_core.orbit.messages.state import StateVector as StateVector
    from magcal_core.orbit.propagators.numerical import NumericalOrbit as NumericalOrbit
    from magcal_core.orbit.propagators.sgp4 import Sgp4Orbit as Sgp4Orbit
    from magcal_core.orbit.sources import parse_orbits as parse_orbits
    from magcal_core.pipeline import CalibrationOptions as CalibrationOptions
    from magcal_core.pipeline import calibrate as calibrate
    from magcal_core.reference.columns import with_reference as with_reference
    from magcal_core.samples import Samples as Samples
    from magcal_core.sensor.model import SensorModel as SensorModel
    from magcal_core.simulation.telemetry import simulate as simulate
    from magcal_core.telemetry import read_samples as read_samples
    from magcal_core.which_object import which_object as which_object

_HOME: Final[dict[str, str]] = {
    "Calibration": "calibration.result",
    "CalibrationOptions": "pipeline",
    "CoefficientFile": "field.coefficients",
    "DirectDipole": "field.dipole",
    "FitMoments": "calibration.refit.moments",
    "Igrf": "field.igrf",
    "Index": "field.index",
    "NumericalOrbit": "orbit.propagators.numerical",
    "OemOrbit": "orbit.ephemeris.oem",
    "RefitOptions": "calibration.refit.outcome",
    "Samples": "samples",
    "SensorModel": "sensor.model",
    "Sgp4Orbit": "orbit.propagators.sgp4",
    "StateVector": "orbit.messages.state",
    "Trend": "calibration.sessions.trend",
    "bias_path": "calibration.terms.bias_path",
    "bias_steps": "calibration.terms.bias_steps",
    "calibrate": "pipeline",
    "field_model": "field.models",
    "parse_orbits": "orbit.sources",
    "read_field_file": "field.coefficient_files",
    "read_index": "field.index_files",
    "read_samples": "telemetry",
    "refit": "calibration.refit.refit",
    "simulate": "simulation.telemetry",
    "trend": "calibration.sessions.trend",
    "which_object": "which_object",
    "with_reference": "reference.columns",
}

__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value

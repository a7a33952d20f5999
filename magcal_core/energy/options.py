"""What an energy balance may be asked for, checked once, whoever asks: a program, the command line or a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from math import isfinite
from typing import TYPE_CHECKING, Final

from magcal_core.constants import EGM96_MAX_DEGREE
from magcal_core.energy.forms import FORMS
from magcal_core.errors import Fault, OptionError

if TYPE_CHECKING:
    from magcal_core.orbit.propagators.forces import RotationName

METHODS: Final = ("least-squares", "collocation", "semi-analytic")
"""Ways to recover coefficients."""
MAX_SAMPLES: Final = 1_000_000
MAX_DURATION_S: Final = 366 * 86400.0

Option = float | int | bool | str | None


@dataclass(frozen=True, slots=True)
class EnergyOptions:
    """Options of an energy balance.

    Attributes
    ----------
    duration_s, step_s : float
        Length of the track and spacing of its samples, s.
    degree : int
        Degree and order of EGM96, 0 to 36.
    third_bodies, tide : bool
        Whether Sun and Moon and the solid tide act.
    orbit : str
        What becomes of a TLE: ``numerical``, integrated from its state at its epoch, or ``sgp4``, its own states.
    form : str
        One of `magcal_core.energy.forms.FORMS`; ``corrected``, or ``printed`` as in the paper.
    recover : int, optional
        Degree up to which coefficients are recovered.
    method : str
        How: one of `METHODS`.
    noise_position_m, noise_velocity_m_s : float
        1-sigma white noise added to the states that the recovery sees, m and m/s.
    seed : int
        Seed of that noise.
    rotation : str
        ``iers``, or ``uniform`` for the ideal Earth.
    drag_density_kg_m3, drag_area_over_mass_m2_kg, drag_scale_height_km : float
        Exponential atmosphere at the radius of the first state, and Cd A / m.

    Raises
    ------
    OptionError
        With one fault for each option that cannot be.
    """

    duration_s: float
    step_s: float
    degree: int = 12
    third_bodies: bool = True
    tide: bool = False
    orbit: str = "numerical"
    form: str = "corrected"
    recover: int | None = None
    method: str = "least-squares"
    noise_position_m: float = 0.0
    noise_velocity_m_s: float = 0.0
    seed: int = 0
    rotation: RotationName = "iers"
    drag_density_kg_m3: float = 0.0
    drag_area_over_mass_m2_kg: float = 0.0
    drag_scale_height_km: float = 65.0

    def __post_init__(self) -> None:
        faults = [
            Fault(name, why, repr(getattr(self, name)))
            for name, (holds, why) in _RULES.items()
            if not holds(getattr(self, name))
        ]
        if not faults and self.duration_s / self.step_s > MAX_SAMPLES:
            faults.append(Fault("step_s", f"makes more than {MAX_SAMPLES} samples", repr(self.step_s)))
        if not faults and self.duration_s < 2 * self.step_s:
            faults.append(Fault("duration_s", "must be two steps or more", repr(self.duration_s)))
        if faults:
            raise OptionError(f"energy balance: {len(faults)} option(s) cannot be as given", faults)

    @classmethod
    def from_dict(cls, options: Mapping[str, object]) -> EnergyOptions:
        """Return the options in ``options``.

        Raises
        ------
        OptionError
            An option is unknown, missing or has a value that it cannot have; each is named.
        """
        known = {field.name for field in fields(cls)}
        faults = [Fault(str(name), "is not an option of an energy balance") for name in options if name not in known]
        faults += [Fault(name, "is missing") for name in ("duration_s", "step_s") if name not in options]
        if faults:
            raise OptionError(f"energy balance: {len(faults)} option(s) cannot be as given", faults)
        return cls(**options)  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, Option]:
        """Return the options as JSON takes them."""
        return asdict(self)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _within(low: float, high: float) -> Callable[[object], bool]:
    return lambda value: _is_number(value) and low <= value <= high  # type: ignore[operator]


def _whole(low: int, high: int) -> Callable[[object], bool]:
    return lambda value: isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def _one_of(*names: str) -> Callable[[object], bool]:
    return lambda value: isinstance(value, str) and value in names


def _is_flag(value: object) -> bool:
    return isinstance(value, bool)


def _is_recovery(value: object) -> bool:
    return value is None or _whole(2, EGM96_MAX_DEGREE)(value)


_RULES: Final[Mapping[str, tuple[Callable[[object], bool], str]]] = {
    "duration_s": (_within(1e-3, MAX_DURATION_S), "must be a number of seconds, more than 0 and at most 366 days"),
    "step_s": (_within(1e-3, 86400.0), "must be a number of seconds from 0.001 to 86400"),
    "degree": (_whole(0, EGM96_MAX_DEGREE), f"must be a whole number from 0 to {EGM96_MAX_DEGREE}"),
    "third_bodies": (_is_flag, "must be true or false"),
    "tide": (_is_flag, "must be true or false"),
    "orbit": (_one_of("numerical", "sgp4"), "must be numerical or sgp4"),
    "form": (_one_of(*FORMS), f"must be one of {', '.join(FORMS)}"),
    "recover": (_is_recovery, f"must be a whole number from 2 to {EGM96_MAX_DEGREE}"),
    "method": (_one_of(*METHODS), f"must be one of {', '.join(METHODS)}"),
    "noise_position_m": (_within(0.0, 1e6), "must be a number of metres from 0 to 1e6"),
    "noise_velocity_m_s": (_within(0.0, 1e4), "must be a number of m/s from 0 to 1e4"),
    "seed": (_whole(0, 2**63 - 1), "must be a whole number from 0"),
    "rotation": (_one_of("iers", "uniform"), "must be iers or uniform"),
    "drag_density_kg_m3": (_within(0.0, 1e-6), "must be a number of kg/m3 from 0 to 1e-6"),
    "drag_area_over_mass_m2_kg": (_within(0.0, 1e3), "must be a number of m2/kg from 0 to 1e3"),
    "drag_scale_height_km": (_within(1.0, 1e3), "must be a number of km from 1 to 1000"),
}

"""The options of a calibration as requests carry them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.http.schemas import Body
from app.jobs.schemas import GyroBody


class CalibrationOptionsBody(Body):
    """Options of a calibration; what is left out has the default of `magcal calibrate`."""

    method: Literal["scalar", "scalar-hooke-jeeves", "vector", "vector-closed-form"] | None = None
    orbit: Literal["sgp4", "numerical"] | None = None
    field: str | None = Field(None, max_length=32)
    field_max_degree: int | None = Field(None, ge=1, le=13)
    time_offset: Literal["auto", "none", "estimate"] | None = None
    time_drift: bool | None = None
    regressors: list[str] | Literal["auto"] | None = None
    response: Literal["none", "auto"] | None = None
    robust: Literal["auto", "none", "huber", "soft_l1", "cauchy", "tukey"] | None = None
    noise_model: Literal["auto", "none", "white"] | None = None
    noise_nt: float | None = Field(None, gt=0, description="Unset: the magnetometer's.")
    locked_terms: Literal["auto", "none"] | None = None
    gyro: GyroBody | None = None
    max_orbit_age_days: float | None = Field(None, ge=0, le=36525)
    bootstrap: int | None = Field(None, ge=0, le=10_000)
    seed: int | None = Field(None, ge=0)

    @property
    def options(self) -> dict[str, object]:
        """The options that were given, under their names."""
        names = set(CalibrationOptionsBody.model_fields) - {"gyro"}
        given = {name: value for name, value in self.model_dump(include=names).items() if value is not None}
        return given if self.gyro is None else {**given, "gyro": self.gyro.columns, "gyro_unit": self.gyro.unit}

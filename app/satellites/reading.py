"""What is said of a magnetometer's telemetry: what can be, and how the database has it."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

from app.http.schemas import utc_text
from app.satellites.tables import Magnetometer
from magcal_core.telemetry.time_forms import BOOT, TimeForm
from magcal_core.telemetry.validity import Validity
from magcal_core.units import COUNTS, nt_per


def unit_of(row: Magnetometer) -> str:
    """Return the unit of a magnetometer: counts where the nT in one are known."""
    return row.unit if row.nt_per_count is None else COUNTS


def options_of(row: Magnetometer) -> dict[str, object]:
    """Return what a magnetometer says of its calibrations' options; a request may say otherwise."""
    return {"noise_nt": row.noise_nt, "integration_s": row.integration_s}


def changed(row: Magnetometer, wanted: Mapping[str, object]) -> None:
    """Set on ``row`` what is ``wanted`` of its telemetry, checked.

    Raises
    ------
    InputError
        The unit, the form of the times or the values of the validity cannot be.
    """
    values = dict(wanted)
    unit = str(values.pop("unit", None) or unit_of(row))
    if unit != COUNTS and "nt_per_count" not in values:
        values["nt_per_count"] = None
    epoch = values.get("time_epoch")
    if isinstance(epoch, datetime):
        values["time_epoch"] = utc_text(epoch)
    for name, value in values.items():
        setattr(row, name, value)
    nt_per(unit, row.nt_per_count)
    row.unit = "nT" if unit == COUNTS else unit
    # The instant that seconds since boot count from may come with each upload.
    form = row.time_format or ""
    is_boot = row.time_epoch is None and form.strip().lower().replace("_", "-") in (BOOT, "seconds-since-boot")
    if not is_boot:
        TimeForm.of(row.time_format, row.time_epoch)
    Validity.of(row.validity_column, row.valid_values)

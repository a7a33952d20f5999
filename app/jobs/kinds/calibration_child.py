"""What runs in the child for a calibration: columnar chunks and orbits in, a record, residuals and moments out."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from app.indices.repository import sources_of
from app.jobs.kinds.calibration import CalibrationWork
from app.jobs.kinds.contract import Outcome, Report, WrongKindError
from app.orbits.parsing import orbit_of
from app.records.arrow import to_bytes
from app.records.json_numbers import without_nan
from app.records.residual_table import residual_table
from app.sessions.repository import samples_of
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.calibration.result import Calibration
from magcal_core.calibration.sessions.monitoring import ActiveSet
from magcal_core.compile_kernels import calibrate_made_up_session
from magcal_core.errors import EstimationError, InputError
from magcal_core.field.sources import FieldSources
from magcal_core.options import CalibrationOptions
from magcal_core.orbit import Orbit
from magcal_core.pipeline import calibrate as run
from magcal_core.sessions import calibrate_jointly


def calibrate(work: object, report: Report) -> Outcome:
    """Return the parameter set, residual table and moments of one calibration."""
    if not isinstance(work, CalibrationWork):
        raise WrongKindError("not a calibration")
    orbits = [orbit_of(content) for _, content in work.orbits]
    options = CalibrationOptions.from_dict(work.options)
    together = samples_of([chunk for chunks in work.columns for chunk in chunks])
    active = None if work.active is None else ActiveSet.from_record(work.active)
    candidates = [orbit_of(content) for content in work.candidates]
    sources = sources_of(work.intervals, work.field_file)
    found = run(
        together,
        orbits,
        options,
        index=sources.indices,
        field_file=sources.file,
        active=active,
        candidates=candidates,
        with_moments=True,
        progress=report,
    )
    document = found.to_dict()
    compared = document.get("agreement")
    if isinstance(compared, dict) and work.active is not None:
        document["agreement"] = {"parameter_set_id": work.active["id"], **compared}
    if len(work.columns) > 1:
        document["joint"] = _joint(work, orbits, found, sources)
    record = without_nan(document)
    if not isinstance(record, dict):
        raise WrongKindError("a calibration's record is not a mapping")
    _complete_provenance(record["provenance"], work)
    _name_strangers(record, work)
    return Outcome(record, _blobs(found))


def _blobs(found: Calibration) -> dict[str, bytes]:
    """Return what is kept beside the record: the residuals, and the moments where the method leaves any."""
    blobs = {"residuals": to_bytes(residual_table(found.residuals))}
    return blobs if found.moments is None else blobs | {"moments": found.moments.to_bytes()}


def _joint(
    work: CalibrationWork, orbits: Sequence[Orbit], found: Calibration, sources: FieldSources
) -> dict[str, object]:
    """Return what the sessions say one by one and together: shared axes, a bias for each, and whether they agree."""
    sessions = {
        str(one["session_id"]): samples_of(chunks) for one, chunks in zip(work.inputs, work.columns, strict=True)
    }
    chosen = CalibrationOptions.from_dict({**found.options, "regressors": list(found.parameters.regressors)})
    try:
        return calibrate_jointly(
            sessions, orbits, chosen, time_offset_s=found.parameters.time_offset_s or 0.0, sources=sources
        ).to_dict()
    except (InputError, EstimationError) as error:
        return {"error": {"code": error.code, "detail": str(error)}}


def _complete_provenance(provenance: dict[str, object], work: CalibrationWork) -> None:
    """Add to the provenance what only the service knows: the software, the inputs and the orbits' ids."""
    provenance["software"] = {"name": "magcal-service", "version": version("magcal-service"), "numpy": np.__version__}
    provenance["inputs"] = [dict(one) for one in work.inputs]
    orbits = provenance.get("orbits")
    for orbit in orbits if isinstance(orbits, list) else []:
        orbit["id"] = work.orbits[orbit.pop("index")][0]


def _name_strangers(record: dict[str, object], work: CalibrationWork) -> None:
    """Add a warning of each orbit that was used and is of another object than the satellite."""
    provenance, warnings = record["provenance"], record["warnings"]
    used = provenance.get("orbits") if isinstance(provenance, dict) else None
    if isinstance(warnings, list) and isinstance(used, list):
        names = [str(orbit["id"]) for orbit in used]
        warnings += [
            f"orbit_of_another_object: orbit {one}: {work.strangers[one]}" for one in names if one in work.strangers
        ]


def warm(_work: object, _report: Report) -> Outcome:
    """Calibrate made-up sessions, so that a new child has everything loaded and compiled."""
    for method in ESTIMATORS:
        found = calibrate_made_up_session(method)
    return Outcome({}, _blobs(found))

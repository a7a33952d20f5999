"""What a form may offer: the names that the registries have, and the defaults, brought along inside a page."""

from __future__ import annotations

from functools import cache

from app.reporting.figures.page import script_json
from magcal_core.units import COUNTS, NT_PER_UNIT


@cache
def choices_json() -> str:
    """Return the choices as JSON that may stand inside a page."""
    import json

    from magcal_core import options
    from magcal_core.calibration.estimators.registry import ESTIMATORS
    from magcal_core.field.models import FIELD_MODELS
    from magcal_core.telemetry.formats import SUFFIXES, WRITERS, media_type_of
    from magcal_core.telemetry.time_forms import PARTS, WORDS

    named = {
        "method": list(ESTIMATORS),
        "field": list(FIELD_MODELS),
        "orbit": options.ORBIT_MODELS,
        "time_offset": options.TIME_OFFSETS,
        "robust": options.ROBUST_LOSSES,
        "noise_model": options.NOISE_MODELS,
        "locked_terms": options.LOCKED_TERMS,
        "bias_steps": options.BIAS_STEPS,
        "response": options.RESPONSES,
    }
    return script_json(
        json.dumps(
            {
                "options": named,
                "defaults": options.CalibrationOptions().to_dict(),
                "formats": list(WRITERS),
                "types": {ending: media_type_of(name) for ending, name in SUFFIXES.items()},
                "units": [*NT_PER_UNIT, COUNTS],
                "time_formats": {name: words for name, words in WORDS.items() if name not in PARTS or name == "doy"},
            }
        )
    )

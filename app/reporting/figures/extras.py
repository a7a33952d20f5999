"""What only some parameter sets carry beside their parameters, read for figures and tables."""

from __future__ import annotations

from collections.abc import Mapping

from app.records.parameter_set import ParameterSetRecord
from app.reporting.figures.parameters import AblationRow


def ablation_rows(record: ParameterSetRecord) -> list[AblationRow]:
    """Return the models that were tried for ``record``, none where the choice was the user's."""
    tried = record.get("ablation")
    if not isinstance(tried, list):
        return []
    return [_ablation_row(row) for row in tried if isinstance(row, Mapping)]


def _ablation_row(row: Mapping[str, object]) -> AblationRow:
    regressors = row.get("regressors")
    names = [str(name) for name in regressors] if isinstance(regressors, list) else []
    held_out = row.get("cross_validated_rms_nt")
    rms = row.get("rms_nt")
    return AblationRow(
        name=str(row.get("name") or " + ".join(["9 parameters", *names])),
        rms_nt=float(rms) if isinstance(rms, int | float) else float("nan"),
        cross_validated_rms_nt=float(held_out) if isinstance(held_out, int | float) else None,
        is_chosen=bool(row.get("selected")),
    )

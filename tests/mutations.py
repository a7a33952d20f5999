"""Plant single faults in a copy of the code and see whether the tests notice: `make mutations`, or names of faults.

Each fault is one change of one place: a sign, a factor, a transposition, a dropped term, a lock that is not taken. The
named tests run against the copy; a fault that they let pass survives, and wants a test. No part of `make test`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parent.parent
COPIED: Final = ("app", "magcal_core", "magcal_client", "migrations", "tests", "pyproject.toml")
LONGEST_S: Final = 900
FAILED: Final = 1
"""Exit status of pytest where tests have failed; others say that they could not run."""

SENSOR: Final = "magcal_core/sensor"
ESTIMATORS: Final = "magcal_core/calibration/estimators"
UNCERTAINTY: Final = "magcal_core/calibration/uncertainty"
VERDICT: Final = "magcal_core/calibration/verdict"
FRAMES: Final = "magcal_core/orbit/earth/frames.py"
LEASES: Final = "app/jobs/execution/leases.py"
TRANSITIONS: Final = "app/jobs/transitions.py"
CORE_TESTS: Final = "tests/magcal_core/calibration"


@dataclass(frozen=True)
class Fault:
    """One change of one place, and the tests that are to notice it."""

    file: str
    before: str
    after: str
    tests: tuple[str, ...]


FAULTS: Final[dict[str, Fault]] = {
    # ------------------------------------------------------------------------------------------------ the sensor
    "sign-of-an-angle": Fault(
        f"{SENSOR}/model.py", "[s[1], c[1] * s[2], c[1] * c[2]]", "[s[1], -c[1] * s[2], c[1] * c[2]]",
        ("tests/magcal_core/sensor/test_model.py",),
    ),
    "term-of-the-inverse": Fault(
        f"{SENSOR}/model.py", "(d * e - b * f) / (a * b * c)", "(d * e) / (a * b * c)",
        ("tests/magcal_core/sensor/test_model.py",),
    ),
    "transposed-correction": Fault(
        f"{SENSOR}/model.py", "- self.bias_nt) @ self.correction_matrix.T", "- self.bias_nt) @ self.correction_matrix",
        ("tests/magcal_core/sensor/test_model.py",),
    ),
    "jacobian-in-rad": Fault(
        f"{SENSOR}/parameterisation.py", "    inner[3:] = np.rad2deg(inner[3:])\n", "",
        (f"{CORE_TESTS}/estimators/test_vector.py",),
    ),
    "mean-of-a-regressor": Fault(
        f"{SENSOR}/parameterisation.py", "bias_nt - z.mean @ per_unit", "bias_nt + z.mean @ per_unit",
        ("tests/magcal_core/sensor/test_correction.py",),
    ),
    "regressor-is-added": Fault(
        f"{SENSOR}/correction.py", "h_nt = h_nt - term_nt(", "h_nt = h_nt + term_nt(",
        ("tests/magcal_core/sensor/test_correction.py",),
    ),
    "drift-before-its-base": Fault(
        f"{SENSOR}/regressors.py", "float((t_utc - base_utc) / np", "float((base_utc - t_utc) / np",
        ("tests/magcal_core/sensor/test_regressors.py",),
    ),
    # --------------------------------------------------------------------------------------------- the estimators
    "undamped-search": Fault(
        "magcal_core/numerics/levenberg_marquardt.py", "max(10 * search[0], DAMPING_START)", "DAMPING_LIMIT * 10",
        (f"{CORE_TESTS}/estimators/test_scalar_descent.py",),
    ),
    "attenuation-added": Fault(
        f"{ESTIMATORS}/closed_form_rows.py", "moments[-1, -1] -= total", "moments[-1, -1] += total",
        (f"{CORE_TESTS}/estimators/test_closed_form.py",),
    ),
    "candidates-intercept": Fault(
        f"{ESTIMATORS}/closed_form_rows.py",
        "self.intercepts_nt[axis] / p**2", "self.intercepts_nt[axis] / p",
        (f"{CORE_TESTS}/estimators/test_closed_form.py",),
    ),
    "freedom-of-a-row": Fault(
        f"{ESTIMATORS}/vector_rows.py", "max(count - columns - 1 - k, 1)", "max(2 * count, 1)",
        (f"{CORE_TESTS}/estimators/test_vector.py",),
    ),
    "centre-of-a-row": Fault(
        f"{ESTIMATORS}/vector_rows.py",
        "found[:, -1] - found[:, :-1] @ regression.centre", "found[:, -1]",
        (f"{CORE_TESTS}/estimators/test_vector.py",),
    ),
    "one-test-too-few": Fault(
        f"{ESTIMATORS}/vector_rows.py", "/ full.sigma_nt**2) / 3.0", "/ full.sigma_nt**2) / 9.0",
        (f"{CORE_TESTS}/estimators/test_vector.py",),
    ),
    "losing-axis": Fault(
        "magcal_core/numerics/robust.py", "prior * (weight - slope), 3).max()", "prior * (weight - slope), 3).min()",
        ("tests/magcal_core/numerics/test_robust.py",),
    ),
    # ------------------------------------------------------------------------------------------------- the frames
    "earth-turns-back": Fault(
        FRAMES,
        "matrix[..., 0, 1] = sin\n    matrix[..., 1, 0] = -sin",
        "matrix[..., 0, 1] = -sin\n    matrix[..., 1, 0] = sin",
        ("tests/magcal_core/orbit/earth/test_frames.py",),
    ),
    "pole-left-out": Fault(
        FRAMES, "return polar_motion_matrix(t_utc) @ rotation_z(gmst_rad)", "return rotation_z(gmst_rad)",
        ("tests/magcal_core/orbit/earth/test_frames.py",),
    ),
    "equinoxes-left-out": Fault(
        FRAMES, "of_date @ rotation_z(-erfa.eqeq94(*tt))", "of_date @ rotation_z(erfa.eqeq94(*tt))",
        ("tests/magcal_core/orbit/earth/test_frames.py",),
    ),
    "transposed-bias": Fault(
        FRAMES, "gcrf_to_itrf_matrix(t_utc) @ np.transpose(bias)", "gcrf_to_itrf_matrix(t_utc) @ bias",
        ("tests/magcal_core/orbit/earth/test_frames.py",),
    ),
    "velocity-of-the-frame": Fault(
        FRAMES, "v_km_s + np.cross(omega_rad_s, r_km)", "v_km_s - np.cross(omega_rad_s, r_km)",
        ("tests/magcal_core/orbit/earth/test_frames.py",),
    ),
    # ---------------------------------------------------------------------------------------------- the covariance
    "white-alone": Fault(
        f"{UNCERTAINTY}/honest_covariance.py",
        "np.maximum(variances * (student_95(frequencies) / 1.96) ** 2, formal)", "formal",
        (f"{CORE_TESTS}/uncertainty/test_honest_covariance.py",),
    ),
    "taken-by-the-fit": Fault(
        f"{UNCERTAINTY}/low_frequencies.py", "np.maximum(own - taken, ", "np.maximum(own, ",
        (f"{CORE_TESTS}/uncertainty/test_low_frequencies.py",),
    ),
    "size-of-a-memory": Fault(
        f"{UNCERTAINTY}/low_frequencies.py", "np.sqrt(rest * self.sizes[:, None] / count)", "np.sqrt(rest / count)",
        (f"{CORE_TESTS}/uncertainty/test_low_frequencies.py",),
    ),
    "angles-of-the-field-error": Fault(
        f"{UNCERTAINTY}/field_error.py", "    jacobian[3:] = np.rad2deg(jacobian[3:])\n", "",
        (f"{CORE_TESTS}/uncertainty/test_field_error.py",),
    ),
    "bias-of-the-field-error": Fault(
        f"{UNCERTAINTY}/field_error.py", "    back[6:9, 0:3] = np.eye(3)\n", "",
        (f"{CORE_TESTS}/uncertainty/test_field_error.py",),
    ),
    "errors-of-one-alone": Fault(
        f"{VERDICT}/agreement.py", "covariance[:_COMPARED, :_COMPARED] + active", "active",
        (f"{CORE_TESTS}/verdict/test_agreement.py",),
    ),
    # ------------------------------------------------------------------------------------------------- the verdict
    "not-a-number-passes": Fault(
        f"{VERDICT}/verdict.py", "    if not np.isfinite(value):", "    if value is None:",
        (f"{CORE_TESTS}/test_verdict.py",),
    ),
    "refused-is-weak": Fault(
        f"{VERDICT}/verdict.py", "refused = value >= limits.refuse", "refused = value > 10.0 * limits.refuse",
        (f"{CORE_TESTS}/test_verdict.py", f"{CORE_TESTS}/test_reason_codes.py"),
    ),
    "gravest-last": Fault(
        f"{VERDICT}/verdict.py", '"refuse" if "refuse" in grades else', '"weak" if "refuse" in grades else',
        (f"{CORE_TESTS}/test_verdict.py",),
    ),
    # ------------------------------------------------------------------------------------------------- the fencing
    "attempt-not-asked": Fault(
        LEASES, "job.attempts == claim.attempt, job.state", "job.state",
        ("tests/app/reliability/test_two_writers.py",),
    ),
    "any-attempt-may-finish": Fault(
        TRANSITIONS, 'JOBS.c.attempts == bindparam("of_attempt")', 'bindparam("of_attempt") > 0',
        ("tests/app/reliability/test_two_writers.py", "tests/app/jobs/test_kinds.py"),
    ),
    "parent-not-locked": Fault(
        TRANSITIONS, "(Job.id == parent_id).with_for_update(key_share=True)", "(Job.id == parent_id)",
        ("tests/app/reliability/test_two_writers.py",),
    ),
}  # fmt: skip


def verdict_on(fault: Fault, copy: Path) -> str:
    """Return ``killed`` or ``survived``, or why the tests could not say."""
    path = copy / fault.file
    sound = path.read_text(encoding="utf-8")
    if sound.count(fault.before) != 1:
        return f"does not fit: {sound.count(fault.before)} places"
    path.write_text(sound.replace(fault.before, fault.after), encoding="utf-8")
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *fault.tests],
            cwd=copy,
            env={**os.environ, "PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
            check=False,
            timeout=LONGEST_S,
        )
    except subprocess.TimeoutExpired:
        return "killed (time)"
    finally:
        path.write_text(sound, encoding="utf-8")
    if done.returncode == FAILED:
        return "killed"
    return "survived" if done.returncode == 0 else f"not tested: {done.stdout[-300:]}{done.stderr[-300:]}"


def main(names: list[str]) -> int:
    """Plant the faults ``names``, all of them where none is named, and return 1 where one survives."""
    chosen = {name: FAULTS[name] for name in names} if names else FAULTS
    left = []
    with tempfile.TemporaryDirectory(prefix="mutations") as folder:
        copy = Path(folder)
        for one in COPIED:
            if (ROOT / one).is_dir():
                shutil.copytree(ROOT / one, copy / one, ignore=shutil.ignore_patterns("*.pyc"))
            else:
                shutil.copy2(ROOT / one, copy / one)
        for name, fault in chosen.items():
            said = verdict_on(fault, copy)
            sys.stdout.write(f"{name}: {said}\n")
            sys.stdout.flush()
            if not said.startswith("killed"):
                left.append(name)
    sys.stdout.write(f"{len(chosen) - len(left)} of {len(chosen)} killed{': not ' if left else ''}{', '.join(left)}\n")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

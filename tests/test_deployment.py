"""Dockerfile and compose file: linted, valid, and run as far as that goes without an engine."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import pytest
import yaml

from app.settings import Settings

ROOT = Path(__file__).resolve().parent.parent
NEEDS_AN_ENGINE = ("useradd", "install --directory", "compile_kernels")
"""Commands of steps that change the system of the image, or take minutes (tests/app/test_kernels.py has these)."""
TOOLS = Path(sys.executable).parent


def instructions() -> list[tuple[str, str]]:
    """Return the instructions of the Dockerfile: name and arguments, lines that go on joined."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in lines]


def test_the_dockerfile_passes_hadolint():
    lint = subprocess.run(
        [TOOLS / "hadolint", "--failure-threshold", "info", ROOT / "Dockerfile"], capture_output=True, check=False
    )
    assert lint.returncode == 0, lint.stdout.decode()


def test_the_compose_file_is_valid():
    command = [TOOLS / "check-jsonschema", "--builtin-schema", "vendor.compose-spec", ROOT / "docker-compose.yml"]
    check = subprocess.run(command, capture_output=True, check=False)
    assert check.returncode == 0, check.stdout.decode() + check.stderr.decode()


def test_the_image_runs_as_another_user_than_root_with_a_health_check_and_both_roles():
    found = dict(instructions())
    assert int(found["USER"]) > 1000
    assert "healthz" in found["HEALTHCHECK"]
    assert (json.loads(found["ENTRYPOINT"]), json.loads(found["CMD"])) == (["magcal"], ["serve"])
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    assert services["api"]["command"][0] == "serve"
    assert services["worker"]["command"][0] == "worker"
    assert "ports" not in services["worker"]
    assert all(one.get("read_only") and one["cap_drop"] == ["ALL"] for one in (services["api"], services["worker"]))


def test_every_setting_that_is_made_exists():
    known = {f"MAGCAL_{name.upper()}" for name in Settings.model_fields}
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    made = {
        name for service in services.values() for name in service.get("environment", {}) if name.startswith("MAGCAL_")
    }
    made |= {name for kind, text in instructions() if kind == "ENV" for name in re.findall(r"(MAGCAL_\w+)=", text)}
    assert made
    assert made <= known


def test_no_image_names_a_registry():
    images = [text.split()[0] for kind, text in instructions() if kind == "FROM"]
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    images += [one["image"] for one in services.values()]
    assert all("/" not in image and "." not in image.partition(":")[0] for image in images)


def test_kernels_are_compiled_for_the_processor_that_they_run_on():
    build, image = (ROOT / "Dockerfile").read_text().replace("\\\n", " ").split("FROM ")[1:]
    assert 'NUMBA_CACHE_DIR=/opt/magcal/kernels NUMBA_CPU_NAME="$KERNEL_CPU" NUMBA_CPU_FEATURES= ' in build
    assert {"NUMBA_CPU_NAME=$KERNEL_CPU", "NUMBA_CPU_FEATURES="} < set(image.split())
    assert build.count("ARG KERNEL_CPU=x86-64-v3") == image.count("ARG KERNEL_CPU=x86-64-v3") == 1


def test_what_is_copied_is_there_and_not_ignored():
    kept = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    for kind, text in instructions():
        if kind == "COPY" and "--from" not in text:
            for source in text.split()[:-1]:
                assert (ROOT / source).exists()
                assert source in kept


@pytest.fixture(scope="module")
def image(tmp_path_factory) -> Path:
    """The root of an image, built by the Dockerfile's own steps; packages that are here are not fetched again."""
    root = tmp_path_factory.mktemp("image")
    work = root / "src"
    for kind, text in instructions():
        if kind == "WORKDIR":
            work = root / text.strip("/")
            work.mkdir(parents=True, exist_ok=True)
        elif kind == "COPY" and "--from" not in text:
            copy(text.split(), work)
        elif kind == "RUN":
            for step in text.split("&&"):
                if not any(name in step for name in NEEDS_AN_ENGINE):
                    run(step, root, work)
                    lend_packages(root / "opt/magcal")
    return root


def run(step: str, root: Path, work: Path) -> None:
    command = step.replace("/opt/magcal", str(root / "opt/magcal")).replace("python -m", f"{sys.executable} -m")
    done = subprocess.run(shlex.split(command), cwd=work, capture_output=True, check=False, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Installing collected packages" not in done.stdout or "--no-deps" in step, done.stdout


def copy(words: list[str], work: Path) -> None:
    *sources, target = words
    for source in sources:
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, work / target, ignore=shutil.ignore_patterns("__pycache__", "*.nb?"))
        else:
            shutil.copy(ROOT / source, work / target)


def lend_packages(venv: Path) -> None:
    """Let the image's environment see what the tests' one has, so that pip finds every requirement satisfied."""
    site = next((venv / "lib").glob("python*")) / "site-packages"
    (site / "lent.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")


@pytest.mark.slow
def test_the_steps_run_and_what_they_install_serves_and_is_healthy(image, tmp_path):
    """The wheel has everything: pages, migrations, data; the image's own health check says so."""
    settings = dict(
        pair.split("=", 1)
        for kind, text in instructions()
        if kind == "ENV"
        for pair in shlex.split(text)
        if "MAGCAL_" in pair
    )
    port = free_port()
    changed = {
        "MAGCAL_DATA_DIR": str(tmp_path),
        "MAGCAL_HOST": "127.0.0.1",
        "MAGCAL_PORT": str(port),
        "MAGCAL_WORKERS": "0",
    }
    path = f"{image / 'opt/magcal/bin'}:{os.environ['PATH']}"
    environment = {**os.environ, **settings, **changed, "PATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    found = dict(instructions())
    check = json.loads(found["HEALTHCHECK"].partition("CMD")[2])
    command = [*json.loads(found["ENTRYPOINT"]), *json.loads(found["CMD"])]
    with (tmp_path / "log").open("wb") as log:
        server = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=log, stderr=log)
        try:
            deadline = time.monotonic() + 90
            while subprocess.run(check, cwd=tmp_path, env=environment, capture_output=True, check=False).returncode:
                assert server.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < deadline, (tmp_path / "log").read_text()
                time.sleep(0.2)
            where = subprocess.run(
                ["python", "-c", "import app, magcal_core, migrations; print(app.__path__, migrations.__path__)"],
                cwd=tmp_path,
                env=environment,
                capture_output=True,
                check=True,
                text=True,
            )
            assert where.stdout.count(str(image)) == 2
        finally:
            server.terminate()
            server.wait(30)
    assert "admin key: mgc_" in (tmp_path / "log").read_text()


def free_port() -> int:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port

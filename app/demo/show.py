"""The demonstration: a service in a folder of its own, spoken to over HTTP like any other, its results in tables."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from app.client.blocking import Client, Record
from app.demo.tables import drift_table, parameter_table, statistics_table
from app.logs import configure_logs
from app.server import listen, prepare, server_of
from app.settings import Settings, load_settings
from magcal_core.calibration.estimators.registry import ESTIMATORS
from magcal_core.errors import MagcalError
from magcal_core.simulation.dekart_mission import SESSIONS, Pass, simulated, tle_text
from magcal_core.telemetry import write_samples

SATELLITE: Final = "dekart"
MAGNETOMETER: Final = "mgm-1"
START_S: Final = 60.0


class DemoError(MagcalError):
    """The demonstration's own server did not start."""

    code = "demo"


@dataclass(frozen=True, slots=True)
class Mission:
    """A session of the demonstration and the parameter set of each method."""

    session: Pass
    found: Mapping[str, Record]


def run_demo(*, port: int, once: bool) -> None:
    """Fly the mission, print what was found, then serve until interrupted unless ``once``."""
    console = Console(width=None if Console().is_terminal else 110)
    with tempfile.TemporaryDirectory(prefix="magcal-demo-") as folder:
        settings = load_settings().model_copy(
            update={"data_dir": Path(folder), "database_url": None, "store_url": None, "port": port}
        )
        configure_logs(settings.model_copy(update={"log_level": "warning", "log_format": "console"}))
        with _service(settings) as (url, key):
            console.print(f"magcal serves on [bold]{url}[/bold] with its data in {folder}")
            with Client(url, key) as client:
                missions = _fly(client, console)
            for mission in missions:
                console.print(parameter_table(mission.session, mission.found))
                console.print(statistics_table(mission.session, mission.found))
            console.print(drift_table([mission.found["scalar"] for mission in missions]))
            if not once:
                console.print(f"The dashboard is at [bold]{url}/[/bold]; enter this key there:\n{key}")
                console.print("It serves until you press Ctrl-C.")
                _wait_for_interrupt()


@contextmanager
def _service(settings: Settings) -> Iterator[tuple[str, str]]:
    """Yield address and admin key of a service that runs in this process."""
    key = prepare(settings)
    listener = listen(settings.host, settings.port)
    server = server_of(settings)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        deadline = time.monotonic() + START_S
        while not server.started:
            if not thread.is_alive() or time.monotonic() > deadline:
                raise DemoError("the server did not start")
            time.sleep(0.02)
        host, port = listener.getsockname()[:2]
        yield f"http://{host}:{port}", key or ""
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def _fly(client: Client, console: Console) -> list[Mission]:
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        steps = bar.add_task("registering DEKART", total=2 + len(SESSIONS) * (2 + len(ESTIMATORS)))
        client.create_satellite(SATELLITE, name="DEKART", norad_id="46493", cospar_id="2020-068H")
        client.create_magnetometer(SATELLITE, MAGNETOMETER, "nT", noise_nt=100.0)
        bar.update(steps, advance=1, description="sending its TLEs")
        client.send_orbits(SATELLITE, tle_text())
        bar.update(steps, advance=1)
        missions = []
        for session in SESSIONS:
            bar.update(steps, description=f"{session.name}: simulating {session.samples} samples")
            telemetry = write_samples(simulated(session).samples, "csv")
            bar.update(steps, advance=1, description=f"{session.name}: uploading {len(telemetry) / 1e3:.0f} kB")
            session_id = str(client.upload(SATELLITE, MAGNETOMETER, telemetry, "text/csv")["id"])
            bar.update(steps, advance=1)
            found = {}
            for method in ESTIMATORS:
                bar.update(steps, description=f"{session.name}: calibrating, {method}")
                found[method] = client.calibrate([session_id], method=method)
                bar.update(steps, advance=1)
            missions.append(Mission(session, found))
    return missions


def _wait_for_interrupt() -> None:
    try:
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        return

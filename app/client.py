"""The Python client: what `magcal push` and `magcal demo` speak, and programs may.

Every call is safe to repeat, so every call is repeated where the network or the service asks for it: uploads are known
by their bytes, jobs by an Idempotency-Key.
"""

from __future__ import annotations

import base64
import hashlib
import random
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final, Self

import httpx2
from pydantic import JsonValue

from magcal_core.errors import MagcalError
from magcal_core.telemetry import MEDIA_TYPES, format_of_name

Record = dict[str, JsonValue]
Progress = Callable[[float], None]

TRIES: Final = 6
FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0
WORTH_REPEATING: Final = frozenset({408, 429, 502, 503, 504})
PIECE_BYTES: Final = 1 << 18
ENDED: Final = frozenset({"succeeded", "failed", "cancelled"})
POLL_S: Final = 0.05


class ServiceAnswerError(MagcalError):
    """The service refused a call; ``code`` and the message are its own."""

    def __init__(self, status: int, problem: Mapping[str, JsonValue]) -> None:
        faults = problem.get("errors")
        listed = (
            [f"{one['where']}: {one['why']}" for one in faults if isinstance(one, dict)]
            if isinstance(faults, list)
            else []
        )
        super().__init__("; ".join([str(problem.get("detail", f"HTTP {status}")), *listed[:3]]))
        self.status = status
        self.code = str(problem.get("code", "http"))  # type: ignore[misc]


class ServiceUnreachableError(MagcalError):
    """The service did not answer, however often it was asked."""

    code = "unreachable"


class JobFailedError(MagcalError):
    """A job ended without a result."""

    code = "job_failed"


class Client:
    """A magcal service at ``url``, spoken to with ``key``."""

    def __init__(self, url: str, key: str, *, tries: int = TRIES, timeout_s: float = 60.0) -> None:
        self._tries = tries
        self._http = httpx2.Client(
            base_url=f"{url.rstrip('/')}/api/v1",
            headers={"Authorization": f"Bearer {key}", "Accept": "application/json"},
            timeout=timeout_s,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_about: object) -> None:
        self._http.close()

    def create_satellite(self, satellite: str, **about: JsonValue) -> None:
        """Register a satellite; one that is there already is left as it is."""
        self._create("/satellites", {"id": satellite, **about})

    def create_magnetometer(self, satellite: str, magnetometer: str, unit: str, **about: JsonValue) -> None:
        """Register a magnetometer; one that is there already is left as it is."""
        self._create(f"/satellites/{satellite}/magnetometers", {"id": magnetometer, "unit": unit, **about})

    def send_orbits(self, satellite: str, text: str, media_type: str = "text/plain") -> list[JsonValue]:
        """Return the orbits that a message became."""
        answer = self._call(
            "POST", f"/satellites/{satellite}/orbits", content=text.encode(), headers={"Content-Type": media_type}
        )
        items = answer["items"]
        return items if isinstance(items, list) else []

    def upload(
        self, satellite: str, magnetometer: str, content: bytes, media_type: str, progress: Progress | None = None
    ) -> Record:
        """Return the session that telemetry became; the same bytes are the same session."""
        digest = base64.b64encode(hashlib.sha256(content).digest()).decode()
        headers = {
            "Content-Type": media_type,
            "Content-Length": str(len(content)),
            "Content-Digest": f"sha-256=:{digest}:",
        }
        return self._call(
            "POST",
            f"/satellites/{satellite}/sessions",
            params={"magnetometer": magnetometer},
            content=content,
            headers=headers,
            progress=progress,
        )

    def calibrate(self, session_ids: list[str], progress: Progress | None = None, **options: JsonValue) -> Record:
        """Return the parameter set of a calibration, once its job has ended.

        Raises
        ------
        JobFailedError
            The job failed or was cancelled; the message says why.
        """
        body = {"kind": "calibration", "session_ids": list[JsonValue](session_ids), **options}
        job = self._call("POST", "/jobs", json=body, headers={"Idempotency-Key": uuid.uuid4().hex})
        while job["state"] not in ENDED:
            if progress is not None:
                progress(float(str(job["progress"])))
            time.sleep(POLL_S)
            job = self._call("GET", f"/jobs/{job['id']}")
        result, error = job["result"], job["error"]
        if not isinstance(result, dict):
            why = error["detail"] if isinstance(error, dict) else job["state"]
            raise JobFailedError(f"job {job['id']}: {why}")
        return self._call("GET", f"/parameter-sets/{result['parameter_set_id']}")

    def _create(self, path: str, body: Record) -> None:
        try:
            self._call("POST", path, json=body)
        except ServiceAnswerError as error:
            if error.status != 409:
                raise

    def _call(
        self,
        method: str,
        path: str,
        *,
        content: bytes | None = None,
        progress: Progress | None = None,
        **request: object,
    ) -> Record:
        """Return the answer's document, after as many tries as it takes."""
        pause_s = FIRST_PAUSE_S
        for left in reversed(range(self._tries)):
            body = content if content is None or progress is None else _pieces(content, progress)
            try:
                answer = self._http.request(method, path, content=body, **request)  # type: ignore[arg-type]
            except httpx2.TransportError as error:
                if not left:
                    raise ServiceUnreachableError(f"{self._http.base_url} does not answer: {error}") from error
                after = None
            else:
                if answer.is_success:
                    document: Record = answer.json()
                    return document
                if answer.status_code not in WORTH_REPEATING or not left:
                    raise ServiceAnswerError(answer.status_code, _problem(answer))
                after = answer.headers.get("retry-after")
            wanted_s = float(after) if after is not None and after.isdigit() else 0.0
            time.sleep(max(wanted_s, random.uniform(0.5, 1.0) * pause_s))  # noqa: S311  spreads clients, keeps no secret
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
        raise ServiceUnreachableError("no tries were allowed")


def _problem(answer: httpx2.Response) -> Mapping[str, JsonValue]:
    try:
        document = answer.json()
    except ValueError:
        return {}
    return document if isinstance(document, dict) else {}


def _pieces(content: bytes, progress: Progress) -> Iterator[bytes]:
    for start in range(0, len(content), PIECE_BYTES):
        yield content[start : start + PIECE_BYTES]
        progress(min(1.0, (start + PIECE_BYTES) / len(content)))


def media_type_of(path: Path) -> str:
    """Return the media type of a telemetry file by its name; one that its name does not tell is left to its bytes."""
    form = format_of_name(path)
    return next((media_type for media_type, name in MEDIA_TYPES.items() if name == form), "application/octet-stream")

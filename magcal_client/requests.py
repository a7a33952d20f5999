"""What the sync and the async client share: the calls, which answers are worth a repetition, and what refusals become.

Every call here is safe to repeat: uploads are known by their bytes, jobs by an Idempotency-Key, and the rest only reads
or names what it makes.
"""

from __future__ import annotations

import base64
import hashlib
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import SystemRandom
from typing import Final, Optional, Union

import httpx2

from magcal_client.errors import ForeignAnswerError, JobFailedError, ServiceAnswerError, ServiceUnreachableError

JsonValue = Union[None, bool, int, float, str, "list[JsonValue]", "dict[str, JsonValue]"]
Record = dict[str, JsonValue]
Query = Union[str, Sequence[str]]
"""Value of a query: one that is a sequence is sent once for each of its items."""
Progress = Callable[[float], None]

TRIES: Final = 6
FIRST_PAUSE_S: Final = 0.5
LONGEST_PAUSE_S: Final = 30.0
PROBLEM: Final = "application/problem+json"
PROBLEM_TYPE: Final = "urn:magcal:problem:"
EVENT_STREAM: Final = "text/event-stream"
DATABASE_HEADER: Final = "Magcal-Database"
"""Names the service's database in the answer to an upload."""
MOST_CONFIRMED: Final = 1000
"""Digests of one question."""
WORTH_REPEATING: Final = frozenset({408, 429, 502, 503, 504})
PIECE_BYTES: Final = 1 << 18
ENDED: Final = frozenset({"succeeded", "failed", "cancelled"})
MEDIA_TYPES: Final = {
    "csv": "text/csv",
    "ndjson": "application/x-ndjson",
    "json": "application/json",
    "parquet": "application/vnd.apache.parquet",
}
ENDINGS: Final = {
    ".csv": "csv", ".tsv": "csv", ".txt": "csv", ".ndjson": "ndjson", ".jsonl": "ndjson", ".json": "json",
    ".parquet": "parquet", ".pq": "parquet",
}  # fmt: skip
PACKED: Final = frozenset({".gz", ".zst", ".zstd"})


@dataclass(frozen=True)
class Call:
    """One call of the service: method, path under /api/v1, and what goes with it."""

    method: str
    path: str
    params: Mapping[str, Query] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    json: JsonValue = None
    content: Optional[bytes] = None


def creation(path: str, body: Record) -> Call:
    """Return the call that registers something."""
    return Call("POST", path, json=body)


def orbits_call(satellite: str, text: str, media_type: str) -> Call:
    """Return the call that sends an orbit message."""
    return Call("POST", f"/satellites/{satellite}/orbits", headers={"Content-Type": media_type}, content=text.encode())


def upload_call(satellite: str, magnetometer: str, content: bytes, media_type: str) -> Call:
    """Return the call that sends telemetry; its digest lets the service refuse what the network has changed."""
    digest = base64.b64encode(hashlib.sha256(content).digest()).decode()
    headers = {
        "Content-Type": media_type,
        "Content-Length": str(len(content)),
        "Content-Digest": f"sha-256=:{digest}:",
    }
    path = f"/satellites/{satellite}/sessions"
    return Call("POST", path, params={"magnetometer": magnetometer}, headers=headers, content=content)


def calibration_call(session_ids: list[str], options: Record) -> Call:
    """Return the call that starts a calibration; repeated, it starts none but the first."""
    body: Record = {"kind": "calibration", "session_ids": list(session_ids), **options}
    return Call("POST", "/jobs", headers={"Idempotency-Key": uuid.uuid4().hex}, json=body)


def confirm_call(satellite: str, magnetometer: str, digests: Sequence[str]) -> Call:
    """Return the call that asks which telemetry the service has, by the SHA-256 of its bytes."""
    body: Record = {"magnetometer": magnetometer, "sha256": list(digests)}
    return Call("POST", f"/satellites/{satellite}/sessions/confirm", json=body)


def apply_call(parameter_set_id: str, content: bytes, media_type: str, form: str, *, inverse: bool) -> Call:
    """Return the call that corrects telemetry, or with ``inverse`` takes a correction back."""
    params = {"format": form, "inverse": str(inverse).lower()}
    headers = {"Content-Type": media_type, "Content-Length": str(len(content)), "Accept": "*/*"}
    return Call("POST", f"/parameter-sets/{parameter_set_id}/apply", params=params, headers=headers, content=content)


def activation_call(parameter_set_id: str, *, force: bool, reason: Optional[str]) -> Call:
    """Return the call that puts a parameter set in force; repeated, it changes nothing more."""
    body: Record = {"force": force, "reason": reason}
    return Call("POST", f"/parameter-sets/{parameter_set_id}/activate", json=body)


def items_of(page: Record) -> list[Record]:
    """Return the items of a part of a list."""
    items = page.get("items")
    return [one for one in items if isinstance(one, dict)] if isinstance(items, list) else []


def result_path(job: Record) -> str:
    """Return where the parameter set of an ended job is.

    Raises
    ------
    JobFailedError
        The job failed or was cancelled; the message says why.
    """
    result, error = job["result"], job["error"]
    if not isinstance(result, dict):
        why = error["detail"] if isinstance(error, dict) else job["state"]
        raise JobFailedError(f"job {job['id']}: {why}")
    return f"/parameter-sets/{result['parameter_set_id']}"


def progress_of(job: Record) -> float:
    """Return how much of a job is done, 0 to 1."""
    return float(str(job["progress"]))


def document_of(answer: httpx2.Response) -> Record:
    """Return the document of an answer.

    Raises
    ------
    ForeignAnswerError
        It has none, so it is not the service's, whatever its status.
    """
    try:
        document = answer.json()
    except ValueError:
        document = None
    if not isinstance(document, dict):
        raise ForeignAnswerError(answer.status_code, f"HTTP {answer.status_code} without a document of the service")
    return document


def refusal(answer: httpx2.Response) -> ServiceAnswerError:
    """Return the error that an answer stands for; only a problem of the service's own type is the service's."""
    try:
        document = answer.json()
    except ValueError:
        document = {}
    found = document if isinstance(document, dict) else {}
    is_problem = _media_type(answer) == PROBLEM
    is_own = is_problem and found.get("type") == f"{PROBLEM_TYPE}{found.get('code')}"
    return ServiceAnswerError(answer.status_code, found if is_own else {}, is_own=is_own)


def is_event_stream(answer: httpx2.Response) -> bool:
    """Return whether an answer, whose body was not read yet, is a stream of events."""
    return answer.is_success and _media_type(answer) == EVENT_STREAM


def refusal_of_stream(answer: httpx2.Response) -> ServiceAnswerError:
    """Return the error that an answer stands for, which is no stream of the service's events."""
    if answer.is_success:
        return ForeignAnswerError(answer.status_code, f"HTTP {answer.status_code} without a stream of the service")
    return refusal(answer)


def is_worth_repeating(answer: httpx2.Response) -> bool:
    """Return whether the service asks for the same call again: it is busy, or still at work on the first one."""
    status = answer.status_code
    return status in WORTH_REPEATING or (status == 409 and refusal(answer).code == "in_progress")


def raise_unless_passing(
    error: Union[httpx2.RequestError, ServiceAnswerError], tried: int, tries: int, url: object
) -> None:
    """Return where a stream that broke is to be begun anew: ``tried`` times in a row it did, of ``tries`` allowed.

    Raises
    ------
    ServiceAnswerError
        The service refused the stream, or was too busy each time.
    ServiceUnreachableError
        There was no answer.
    """
    if isinstance(error, ServiceAnswerError):
        if error.status not in WORTH_REPEATING or tried >= tries:
            raise error
    elif tried >= tries:
        raise ServiceUnreachableError(f"{url} does not answer: {error}") from error


def pause_s(tried: int, answer: httpx2.Response | None) -> float:
    """Return how long to wait after ``tried`` attempts, s: doubling, spread at random.

    It is at least what the answer asks for, up to `LONGEST_PAUSE_S`: nobody may make a client deaf for a day.
    """
    after = None if answer is None else answer.headers.get("retry-after")
    is_number = after is not None and after.isascii() and after.isdigit()
    wanted_s = min(float(after or 0), LONGEST_PAUSE_S) if is_number else 0.0
    doubled_s = min(FIRST_PAUSE_S * 2.0 ** (tried - 1), LONGEST_PAUSE_S)
    return max(wanted_s, SystemRandom().uniform(0.5, 1.0) * doubled_s)


def pieces(content: bytes, progress: Progress) -> Iterator[bytes]:
    """Yield ``content`` piece by piece, and tell how much of it was taken."""
    for start in range(0, len(content), PIECE_BYTES):
        yield content[start : start + PIECE_BYTES]
        progress(min(1.0, (start + PIECE_BYTES) / len(content)))


def media_type_of(path: Path) -> str:
    """Return the media type of a telemetry file by its name; one that its name does not tell is left to its bytes."""
    return MEDIA_TYPES.get(format_of_name(path) or "", "application/octet-stream")


def format_of_name(path: Path) -> Optional[str]:
    """Return the telemetry format that a file's name tells, compressed or not; None where it tells none."""
    endings = [one.lower() for one in path.suffixes if one.lower() not in PACKED]
    return ENDINGS.get(endings[-1]) if endings else None


def _media_type(answer: httpx2.Response) -> str:
    """Return the media type of an answer, without its parameters."""
    return str(answer.headers.get("content-type", "")).partition(";")[0].strip().lower()

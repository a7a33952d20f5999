"""A ground station's folder: every telemetry file in it reaches the service, whatever fails meanwhile.

The folder itself is the record. A file stays where the receiver wrote it until the service has acknowledged its bytes;
then the acknowledgement is written down (``sent/receipts.ndjson``, forced to disk) and only then the file is moved to
``sent/``. A kill between any two of these steps leaves a file that is sent again or only moved, never one that is lost;
the same bytes sent again are the same session. What lies in ``sent/`` is asked for again, many files at once, and sent
again where the service does not have it.

One file that cannot be sent does not hold up the others: it is tried again behind them.
"""

from __future__ import annotations

import hashlib
import queue
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Optional, TypeVar

from magcal_client.blocking import Client
from magcal_client.errors import ForeignAnswerError, ServiceAnswerError, ServiceUnreachableError, StoppedError
from magcal_client.folder import Look, aside, is_being_written, is_too_long, put_aside, read_file
from magcal_client.receipts import Receipt, append_receipt, read_receipts
from magcal_client.requests import MOST_CONFIRMED, format_of_name, media_type_of

SENT: Final = "sent"
REFUSED: Final = "refused"
RECEIPTS: Final = "receipts.ndjson"
WILL_NEVER_DO: Final = frozenset({413, 415, 422})
"""Answers of the service that the same bytes would get again: the file is put aside."""
NOT_THE_FILE: Final = frozenset({"invalid", "extra_forbidden", "digest_form", "idempotency_mismatch"})
"""Codes of such answers that tell of the request, not of the file."""
NOT_NOW: Final = frozenset({429, 502, 503, 504, 507})
"""Answers that other files would get now too."""
NOT_US: Final = frozenset({401, 403})
"""Answers of the service that every other file would get: the round ends at the first."""
MOST_FAILURES: Final = 3
"""The round ends after so many files in a row that the service did not take now."""
CONFIRM_EVERY_S: Final = 3600.0
LONGEST_CALL_S: Final = 120.0
SLOWEST_BYTES_S: Final = 20_000
"""A call may take so long, and longer by its bytes at this pace: a slow answer does not make the station deaf."""

Result = TypeVar("Result")


@dataclass(frozen=True)
class Destination:
    """Whose telemetry the files are."""

    satellite: str
    magnetometer: str


@dataclass(frozen=True)
class Outcome:
    """What became of a file: ``sent`` (with its session), ``refused`` or ``kept`` (with the reason)."""

    name: str
    state: str
    session_id: Optional[str] = None
    why: Optional[str] = None
    ends_round: bool = False


class Station:
    """The files of one magnetometer in ``folder``, and how they reach a service through ``client``."""

    def __init__(
        self,
        folder: Path,
        client: Client,
        destination: Destination,
        *,
        settle_s: float,
        follow_links: bool = False,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._folder = folder
        self._client = client
        self._destination = destination
        self._settle_s = settle_s
        self._follow_links = follow_links
        self._is_stopped = is_stopped
        self._looks: dict[Path, tuple[Look, float]] = {}
        self._failures: Counter[str] = Counter()
        self._has_answered = False
        self._confirmed_s: float | None = None
        for name in (SENT, REFUSED):
            (folder / name).mkdir(exist_ok=True)
        self._receipts = {
            one.sha256: one
            for one in read_receipts(folder / SENT / RECEIPTS)
            if (one.satellite, one.magnetometer) == (destination.satellite, destination.magnetometer)
        }

    def send_all(self) -> Iterator[Outcome]:
        """Send every file that is whole, the oldest first, and yield what became of each; stop where nobody answers.

        Whole is what has not changed for the settling time and what nobody has open for writing. Files that failed
        before come behind those that did not.
        """
        try:
            yield from self._missing()
            self.look()
        except StoppedError:
            return
        except OSError as error:
            yield Outcome(str(self._folder), "kept", why=str(error), ends_round=True)
            return
        now_s, in_a_row = time.monotonic(), 0
        settled = [path for path, (_, since_s) in self._looks.items() if now_s - since_s >= self._settle_s]
        for path in sorted(settled, key=self._order):
            try:
                outcome = None if is_being_written(path) else self._tried(path)
            except StoppedError:
                return
            if outcome is None:
                continue
            self._count(outcome)
            in_a_row = in_a_row + 1 if outcome.ends_round else 0
            yield outcome
            if in_a_row >= MOST_FAILURES or (outcome.ends_round and not self._has_answered):
                return

    def _order(self, path: Path) -> tuple[int, int, str]:
        return self._failures[path.name], self._looks[path][0].changed_ns, path.name

    def _count(self, outcome: Outcome) -> None:
        if outcome.state == "kept":
            self._failures[outcome.name] += 1
        else:
            self._failures.pop(outcome.name, None)

    def look(self) -> None:
        """See which files there are, and since when each is as it is."""
        now_s = time.monotonic()
        looks: dict[Path, tuple[Look, float]] = {}
        for path in self._folder.iterdir():
            if path.name.startswith(".") or format_of_name(path) is None or not self._is_file(path):
                continue
            look = Look.at(path)
            if look is None:
                continue
            before = self._looks.get(path)
            looks[path] = before if before is not None and before[0] == look else (look, now_s)
        self._looks = looks

    def _is_file(self, path: Path) -> bool:
        """Return whether a name is a file's own; one that leads elsewhere is followed only where that is asked for."""
        try:
            found = path.stat() if self._follow_links else path.lstat()
        except OSError:
            return False
        return stat.S_ISREG(found.st_mode)

    def _tried(self, path: Path) -> Outcome | None:
        """Return what became of a file; whatever is wrong with it or its disk is its own affair."""
        try:
            return self._send(path)
        except OSError as error:
            return Outcome(path.name, "kept", why=str(error))

    def _send(self, path: Path) -> Outcome | None:
        """Return what became of a file; None where it changed or went away while it was looked at."""
        look = Look.at(path)
        content = read_file(path, follow_links=self._follow_links)
        if look is None or content is None or Look.at(path) != look:
            return None
        digest = hashlib.sha256(content).hexdigest()
        try:
            session_id = self._session_of(path, content, digest)
        except ServiceUnreachableError as error:
            return Outcome(path.name, "kept", why=f"{error.code}: {error.message}", ends_round=True)
        except ServiceAnswerError as error:
            return self._refused(path, digest, error)
        if Look.at(path) != look:
            return None  # it has grown since: what is there now is sent when it has settled
        put_aside(path, self._folder / SENT, digest)
        return Outcome(path.name, "sent", session_id=session_id)

    def _session_of(self, path: Path, content: bytes, digest: str) -> str:
        """Return the session that a file is: sent now, or before, where the service says that it still has it."""
        receipt = self._receipts.get(digest)
        if receipt is not None and digest in self._had([digest]):
            return receipt.session_id
        return self._upload(path, content, digest)

    def _upload(self, path: Path, content: bytes, digest: str) -> str:
        """Return the session that a file became, once its acknowledgement is on disk.

        Raises
        ------
        ForeignAnswerError
            What answered does not have these bytes, so it is not the service.
        """
        to = self._destination
        call = lambda: self._client.upload(to.satellite, to.magnetometer, content, media_type_of(path))  # noqa: E731
        session = self._within(LONGEST_CALL_S + len(content) / SLOWEST_BYTES_S, call)
        if (session.get("sha256"), session.get("satellite")) != (digest, to.satellite) or "id" not in session:
            raise ForeignAnswerError(200, "the answer does not name the bytes that were sent")
        self._has_answered = True
        receipt = Receipt(path.name, digest, str(session["id"]), to.satellite, to.magnetometer, self._client.database)
        append_receipt(self._folder / SENT / RECEIPTS, receipt)
        self._receipts[digest] = receipt
        return receipt.session_id

    def _had(self, digests: Sequence[str]) -> set[str]:
        """Return which of ``digests`` the service has, or had until their retention."""
        to = self._destination
        answer = self._within(LONGEST_CALL_S, lambda: self._client.confirm(to.satellite, to.magnetometer, digests))
        held, expired = answer.get("held"), answer.get("expired")
        if not (isinstance(held, list) and isinstance(expired, list) and isinstance(answer.get("database"), str)):
            raise ForeignAnswerError(200, "the answer does not say what the service has")
        self._has_answered = True
        return {str(one) for part in (held, expired) for one in part}

    def _within(self, limit_s: float, call: Callable[[], Result]) -> Result:
        """Return what ``call`` returns; one that takes longer than ``limit_s``, or a stop, leaves it to itself.

        Raises
        ------
        ServiceUnreachableError, StoppedError
            It took too long, or the station was asked to stop.
        """
        done: queue.SimpleQueue[Result | BaseException] = queue.SimpleQueue()
        threading.Thread(target=lambda: done.put(_result_of(call)), daemon=True).start()
        until_s = time.monotonic() + limit_s
        while True:
            try:
                found = done.get(timeout=0.1)
            except queue.Empty:
                if self._is_stopped():
                    raise StoppedError("asked to stop") from None
                if time.monotonic() > until_s:
                    raise ServiceUnreachableError(f"no whole answer within {limit_s:.0f} s") from None
                continue
            if isinstance(found, BaseException):
                raise found
            return found

    def _missing(self) -> Iterator[Outcome]:
        """Send again what the receipts have and the service has not; ask once at the beginning, then now and then."""
        now_s = time.monotonic()
        if self._confirmed_s is not None and now_s - self._confirmed_s < CONFIRM_EVERY_S:
            return
        digests = list(self._receipts)
        try:
            for start in range(0, len(digests), MOST_CONFIRMED):
                part = digests[start : start + MOST_CONFIRMED]
                had = self._had(part)
                for digest in part:
                    if digest not in had and (outcome := self._send_again(self._receipts[digest])) is not None:
                        yield outcome
        except (ServiceUnreachableError, ServiceAnswerError):
            return  # the files of this round will say so
        self._confirmed_s = now_s

    def _send_again(self, receipt: Receipt) -> Outcome | None:
        """Return what became of a file in ``sent/`` that the service does not have; None where it is not there."""
        for name in (receipt.name, aside(receipt.name, receipt.sha256)):
            path = self._folder / SENT / name
            content = read_file(path, follow_links=False) if self._is_file(path) else None
            if content is not None and hashlib.sha256(content).hexdigest() == receipt.sha256:
                try:
                    return Outcome(name, "sent", session_id=self._upload(path, content, receipt.sha256))
                except ServiceAnswerError as error:
                    return Outcome(f"{SENT}/{name}", "kept", why=f"{error.code}: {error.message}")
        return None

    def _refused(self, path: Path, digest: str, error: ServiceAnswerError) -> Outcome:
        why = f"{error.code}: {error.message}"
        is_final = error.is_own and error.status in WILL_NEVER_DO and error.code not in NOT_THE_FILE
        if not is_final:
            ends_round = error.status in NOT_NOW or (error.is_own and error.status in NOT_US)
            return Outcome(path.name, "kept", why=why, ends_round=ends_round)
        target = put_aside(path, self._folder / REFUSED, digest)
        reasons = "\n".join([why, *error.faults])
        name = aside(f"{target.name}.why", digest) if is_too_long(f"{target.name}.why") else f"{target.name}.why"
        target.with_name(name).write_text(f"{reasons}\n", encoding="utf-8", errors="backslashreplace")
        return Outcome(path.name, "refused", why=why)


def _result_of(call: Callable[[], Result]) -> Result | BaseException:
    try:
        return call()
    except BaseException as error:  # noqa: BLE001  the thread's own end: it is raised where the call was made
        return error

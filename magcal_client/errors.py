"""What a call of the service may end with, besides its result."""

from __future__ import annotations

from collections.abc import Mapping


class ClientError(Exception):
    """Base of all; ``code`` names the kind, ``message`` says why."""

    code = "client"

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


class ServiceAnswerError(ClientError):
    """A call was refused; ``is_own`` where the service itself did so: then ``code`` and the message are its own."""

    def __init__(self, status: int, problem: Mapping[str, object], *, is_own: bool = True) -> None:
        faults = problem.get("errors")
        self.is_own = is_own
        listed: list[str] = []
        if isinstance(faults, list):
            listed = [f"{one.get('where')}: {one.get('why')}" for one in faults if isinstance(one, dict)]
        super().__init__("; ".join([str(problem.get("detail", f"HTTP {status}")), *listed[:3]]))
        self.faults = listed
        self.status = status
        self.code = str(problem.get("code", "http"))


class ForeignAnswerError(ServiceAnswerError):
    """Something between here and the service has answered in its place: a proxy, a login page."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(status, {"code": "foreign_answer", "detail": why}, is_own=False)


class ServiceUnreachableError(ClientError):
    """The service did not answer, however often it was asked."""

    code = "unreachable"


class JobFailedError(ClientError):
    """A job ended without a result."""

    code = "job_failed"


class FolderTakenError(ClientError):
    """Another process sends the files of the same folder."""

    code = "folder_taken"


class StoppedError(ClientError):
    """The station was asked to stop while it waited for an answer."""

    code = "stopped"


class PandasMissingError(ClientError):
    """A table was asked for as a data frame, and pandas is not installed."""

    code = "pandas_missing"


def one_line(error: ClientError, program: str) -> str:
    """Return an error as a command line tells it."""
    return f"{program}: {error.code}: {error.message}"

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
    """The service refused a call; ``code`` and the message are its own."""

    def __init__(self, status: int, problem: Mapping[str, object]) -> None:
        faults = problem.get("errors")
        listed: list[str] = []
        if isinstance(faults, list):
            listed = [f"{one['where']}: {one['why']}" for one in faults if isinstance(one, dict)]
        super().__init__("; ".join([str(problem.get("detail", f"HTTP {status}")), *listed[:3]]))
        self.faults = listed
        self.status = status
        self.code = str(problem.get("code", "http"))


class ServiceUnreachableError(ClientError):
    """The service did not answer, however often it was asked."""

    code = "unreachable"


class JobFailedError(ClientError):
    """A job ended without a result."""

    code = "job_failed"


class FolderTakenError(ClientError):
    """Another process sends the files of the same folder."""

    code = "folder_taken"


class PandasMissingError(ClientError):
    """A table was asked for as a data frame, and pandas is not installed."""

    code = "pandas_missing"


def one_line(error: ClientError, program: str) -> str:
    """Return an error as a command line tells it."""
    return f"{program}: {error.code}: {error.message}"

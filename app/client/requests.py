"""What the two clients share, which is `magcal_client`'s."""

from magcal_client.errors import ForeignAnswerError, JobFailedError, ServiceAnswerError, ServiceUnreachableError
from magcal_client.requests import Call, Progress, Query, Record, media_type_of, pause_s

__all__ = [
    "Call",
    "ForeignAnswerError",
    "JobFailedError",
    "Progress",
    "Query",
    "Record",
    "ServiceAnswerError",
    "ServiceUnreachableError",
    "media_type_of",
    "pause_s",
]

"""The blocking client, which is `magcal_client`'s: a small distribution of its own."""

from magcal_client.blocking import Client
from magcal_client.errors import JobFailedError, ServiceAnswerError, ServiceUnreachableError
from magcal_client.requests import Progress, Record, media_type_of

__all__ = [
    "Client",
    "JobFailedError",
    "Progress",
    "Record",
    "ServiceAnswerError",
    "ServiceUnreachableError",
    "media_type_of",
]

"""One attempt at a delivery: signed after the Standard Webhooks specification, to an address that was looked at."""

from __future__ import annotations

import ssl
import threading
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from typing import Final

import httpx2
from standardwebhooks import Webhook as Signer

from app.notifications.hosts import Address, AddressRefusedError, AllowedHosts, Target, WebhookHostError, target_of

STEP_S: Final = 10.0
"""Longest wait for a connection, and between two bytes."""
WHOLE_S: Final = 20.0
"""Longest attempt altogether: a receiver that answers a byte now and then holds nobody up."""
GONE: Final = 410
MOST_RETRY_AFTER_S: Final = 3600.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of an attempt: the status of the answer, None without one, and why it does not count, if so."""

    status: int | None
    reason: str | None
    retry_after_s: float | None = None

    @property
    def is_delivered(self) -> bool:
        """Whether the receiver has taken it."""
        return self.reason is None


@dataclass(frozen=True, slots=True)
class Parcel:
    """What is sent: to which URL, under which id, signed with which secret."""

    url: str
    secret: str
    message_id: str
    body: str


def signed_headers(parcel: Parcel, now: datetime) -> dict[str, str]:
    """Return the headers that sign a parcel at the time ``now`` of the attempt."""
    return {
        "webhook-id": parcel.message_id,
        "webhook-timestamp": str(int(now.timestamp())),
        "webhook-signature": Signer(parcel.secret).sign(parcel.message_id, now, parcel.body),
    }


def attempt(parcel: Parcel, allowed: AllowedHosts, now: datetime) -> Outcome:
    """Return what came of one attempt: only an answer of 200 to 299 is a delivery; redirects are not followed."""
    try:
        target = target_of(parcel.url)
        addresses = allowed.addresses(target)
    except (WebhookHostError, AddressRefusedError) as error:
        return Outcome(None, error.message)
    except OSError as error:
        return Outcome(None, f"the name of the host has no address: {error.strerror or error}")
    reason = "the host has no address"
    for address in addresses:
        try:
            return _post(parcel, target, address, now)
        except httpx2.ConnectError as error:
            reason = f"no connection: {error}"
        except (httpx2.HTTPError, OSError, RuntimeError, ValueError) as error:  # the last two: closed by the clock
            return Outcome(None, f"no answer: {type(error).__name__}")
    return Outcome(None, reason)


def _post(parcel: Parcel, target: Target, address: Address, now: datetime) -> Outcome:
    """Send to that address, under the host's name: what was looked at is what is spoken to."""
    headers = {"host": target.authority, "content-type": "application/json", "user-agent": "magcal"}
    client = httpx2.Client(trust_env=False, follow_redirects=False, timeout=STEP_S, verify=_trusted())
    clock = threading.Timer(WHOLE_S, client.close)
    clock.daemon = True
    clock.start()
    try:
        with client.stream(
            "POST",
            target.at(address),
            content=parcel.body.encode(),
            headers=headers | signed_headers(parcel, now),
            extensions={"sni_hostname": target.host},
        ) as answer:
            return _outcome(answer)
    finally:
        clock.cancel()
        client.close()


@cache
def _trusted() -> ssl.SSLContext:
    """Return the certificates that this machine trusts, read once."""
    return ssl.create_default_context()


def _outcome(answer: httpx2.Response) -> Outcome:
    if answer.is_success:
        return Outcome(answer.status_code, None)
    pause = answer.headers.get("retry-after", "")
    retry_after_s = min(float(pause), MOST_RETRY_AFTER_S) if pause.isdigit() else None
    what = "a redirect, which is not followed" if answer.is_redirect else "a refusal"
    return Outcome(answer.status_code, f"the receiver answered {answer.status_code}, {what}", retry_after_s)

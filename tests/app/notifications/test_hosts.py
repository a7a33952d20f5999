"""Where webhooks may go: names and networks of the list, looked at after resolution; no other private address."""

from __future__ import annotations

import ipaddress
import socket

import pytest

from app.notifications.hosts import AddressRefusedError, AllowedHosts, WebhookHostError, WebhookUrlError, target_of
from app.notifications.sending import Parcel, attempt
from app.storage.database import utc_now

PRIVATE = [
    "127.0.0.1", "10.1.2.3", "192.168.0.1", "172.16.0.1", "169.254.169.254", "100.64.0.1", "224.0.0.1", "0.0.0.1",
    "::1", "fe80::1", "fd00::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1", "2002:7f00:1::",
    "64:ff9b::a00:1", "64:ff9b::7f00:1", "64:ff9b:1::a00:1", "::",
]  # fmt: skip


def resolve_to(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> None:
    """Let every name have these addresses, as a name server under another's control could."""

    def answer(_host: str, port: int, **_how: object) -> list[tuple[object, ...]]:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", answer)


@pytest.mark.parametrize("address", PRIVATE)
def test_a_listed_name_with_a_private_address_is_refused_unless_that_is_listed_too(monkeypatch, address):
    resolve_to(monkeypatch, address)
    target = target_of("https://hooks.example.org/")
    with pytest.raises(AddressRefusedError):
        AllowedHosts.of("hooks.example.org").addresses(target)
    listed = f"hooks.example.org,{address.rpartition('ffff:')[2]}"
    if not address.startswith(("2002:", "64:ff9b::")):  # what counts of such an address is the IPv4 address within
        assert AllowedHosts.of(listed).addresses(target) == [ipaddress.ip_address(address)]


def test_one_private_address_among_public_ones_is_enough_to_refuse(monkeypatch):
    resolve_to(monkeypatch, "93.184.215.14", "10.0.0.1")
    with pytest.raises(AddressRefusedError):
        AllowedHosts.of("a.example").addresses(target_of("https://a.example/"))


def test_public_addresses_of_listed_names_are_allowed(monkeypatch):
    resolve_to(monkeypatch, "93.184.215.14", "2606:2800:21f:cb07:6820:80da:af6b:8b2c")
    assert len(AllowedHosts.of("A.example.").addresses(target_of("https://a.EXAMPLE/"))) == 2


@pytest.mark.parametrize(
    ("listed", "url", "is_listed"),
    [
        ("a.example", "https://a.example/", True),
        ("a.example", "https://b.a.example/", False),
        ("a.example", "https://a.example.evil.example/", False),
        ("a.example:8443", "https://a.example:8443/", True),
        ("a.example:8443", "https://a.example/", False),
        ("127.0.0.1", "http://127.0.0.1:5000/", True),
        ("127.0.0.1:80", "http://127.0.0.1:5000/", False),
        ("10.0.0.0/8", "http://10.9.9.9/", True),
        ("10.0.0.0/8", "http://11.0.0.1/", False),
        ("[::1]:80", "http://[::1]/", True),
        ("::1", "http://[::1]:8080/", True),
        ("", "https://a.example/", False),
        (" , ", "https://a.example/", False),
    ],
)
def test_what_the_list_names(listed, url, is_listed):
    allowed, target = AllowedHosts.of(listed), target_of(url)
    if is_listed:
        allowed.require(target)
    else:
        with pytest.raises(WebhookHostError):
            allowed.require(target)


def test_localhost_names_the_loopback_and_nothing_else(monkeypatch):
    allowed = AllowedHosts.of("localhost")
    assert {str(one) for one in allowed.addresses(target_of("http://localhost/"))} <= {"127.0.0.1", "::1"}
    resolve_to(monkeypatch, "192.168.1.1")
    with pytest.raises(AddressRefusedError):
        allowed.addresses(target_of("http://localhost/"))


def test_a_list_with_a_port_that_is_none_is_refused():
    with pytest.raises(WebhookUrlError):
        AllowedHosts.of("a.example:port")


def test_what_was_looked_at_is_what_is_spoken_to(monkeypatch, receiver):
    """A name that has another address a moment later: the request goes to the one that was checked, under its name."""
    asked = []

    def answer(host: str, port: int, *_rest: object, **_how: object) -> list[tuple[object, ...]]:
        asked.append(host)
        address = "127.0.0.1" if len(asked) == 1 or host == "127.0.0.1" else "10.255.255.1"
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port))]

    monkeypatch.setattr(socket, "getaddrinfo", answer)
    parcel = Parcel(f"http://hooks.example.org:{receiver.port}/hook", "whsec_c2VjcmV0c2VjcmV0c2VjcmV0", "msg_1", "{}")
    receiver.answer = lambda _body: (200, {})
    allowed = AllowedHosts.of("hooks.example.org,127.0.0.1")
    assert attempt(parcel, allowed, utc_now()).is_delivered
    assert receiver.received[0][0]["host"] == f"hooks.example.org:{receiver.port}"
    assert asked[0] == "hooks.example.org"
    assert set(asked[1:]) <= {"127.0.0.1"}


def test_a_refused_address_a_missing_one_and_a_dead_one_are_told_apart(monkeypatch):
    parcel = Parcel("http://hooks.example.org/", "whsec_c2VjcmV0c2VjcmV0c2VjcmV0", "msg_1", "{}")
    assert "does not name" in (attempt(parcel, AllowedHosts.of(""), utc_now()).reason or "")
    resolve_to(monkeypatch, "10.0.0.1")
    outcome = attempt(parcel, AllowedHosts.of("hooks.example.org"), utc_now())
    assert "private address" in (outcome.reason or "")
    resolve_to(monkeypatch)
    assert "no address" in (attempt(parcel, AllowedHosts.of("hooks.example.org"), utc_now()).reason or "")
